"""APT-Gen: a generator trained through a progress value and a return value (paper, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from apt_jax import draws
from apt_jax import replay as rp
from apt_jax.config import BetaRule, Config, HParams
from apt_jax.curricula.apt_gen_objectives import Objectives, make_objectives, task_progress
from apt_jax.curricula.base import GENERATED, TARGET, Curriculum
from apt_jax.descent import ADAM, descend
from apt_jax.losses import adapt_beta, proportional_beta
from apt_jax.networks import init_singular_vectors, spectral_normalize
from apt_jax.networks.apply import apply
from apt_jax.plugin import Metrics
from apt_jax.specs import Params, Spec, Vector, obs_struct, param_struct, zeros_like
from apt_jax.task_space import TaskSpace


class Models(NamedTuple):
    """Parameters of everything that one Adam trains: theta_g, theta_d, theta_1, theta_2 of the paper."""

    generator: Any
    discriminator: Any
    progress_value: Any
    return_value: Any


class AptGenState(NamedTuple):
    """Models, their optimiser, the generator's BatchNorm statistics, the power iteration's vectors, and beta."""

    models: Models
    opt_state: Any
    batch_stats: Any
    spectral: Any
    beta: Float[Array, ""]


def make(space: TaskSpace, config: Config, *, progress_weight: float = 1.0, return_weight: float = 1.0) -> Curriculum:
    """The paper's curriculum.

    Args:
      progress_weight: of V1 in the generator's objective; 0 is the ablation "expected return only" (paper, Sec. 5.3).
      return_weight: of V2 there; 0 is the ablation "task progress only".

    Raises:
      ValueError: an unknown `Config.beta_rule`.
    """
    if config.beta_rule not in get_args(BetaRule):
        raise ValueError(f"beta_rule must be one of {', '.join(get_args(BetaRule))}, got {config.beta_rule!r}")
    objectives = make_objectives(space, config, progress_weight=progress_weight, return_weight=return_weight)
    networks = objectives.networks
    batch = config.model_batch_size
    recent = config.recent_steps // config.envs_per_source
    warm = config.warmup_steps // (2 * config.envs_per_source)

    def noise(key: Key[Array, ""], n: int) -> Float[Array, "n z"]:
        return jax.random.normal(key, (n, config.noise_size))

    def init_ensembles(key: Key[Array, ""]) -> tuple[Any, Any]:
        """Of V1 and of V2, initialised together: that compiles sooner."""
        w = zeros_like(param_struct(space.param_spec))
        values = jax.vmap(lambda key: networks.value.init(key, w))(jax.random.split(key, 2 * config.value_ensemble))
        half = config.value_ensemble
        return jax.tree.map(lambda x: x[:half], values), jax.tree.map(lambda x: x[half:], values)

    def init(key: Key[Array, ""], hparams: HParams) -> AptGenState:
        key_g, key_d, key_v, key_spectral, key_stats = jax.random.split(key, 5)
        variables = networks.generator.init(key_g, jnp.zeros((2, config.noise_size)), train=True)
        obs = zeros_like(obs_struct(space.obs_spec))
        progress_value, return_value = init_ensembles(key_v)
        models = Models(
            generator=variables["params"],
            discriminator=networks.discriminator.init(key_d, obs, jnp.int32(0), reward=jnp.float32(0.0), next_obs=obs),
            progress_value=progress_value,
            return_value=return_value,
        )

        # The first tasks are drawn from running statistics, which must describe the fresh generator before it is used.
        def settle(stats: Any, z: Float[Array, "n z"]) -> tuple[Any, None]:
            return objectives.generate(models.generator, stats, z)[1], None

        z = noise(key_stats, 100 * batch).reshape(100, batch, config.noise_size)
        batch_stats, _ = jax.lax.scan(settle, variables["batch_stats"], z)
        return AptGenState(
            models=models,
            opt_state=ADAM.init(models),
            batch_stats=batch_stats,
            spectral=init_singular_vectors(key_spectral, models.discriminator),
            beta=jnp.asarray(hparams.beta_init, jnp.float32),
        )

    def propose(state: AptGenState, key: Key[Array, ""], n: int, hparams: HParams) -> Params:
        key_z, key_explore = jax.random.split(key)
        variables = {"params": state.models.generator, "batch_stats": state.batch_stats}
        w = apply(networks.generator, variables, noise(key_z, n), train=False)
        return explore(space.param_spec, w, key_explore, hparams)

    def update(
        state: AptGenState, key: Key[Array, ""], replay: rp.Replay, iteration: Int[Array, ""], hparams: HParams
    ) -> tuple[AptGenState, Metrics]:
        key_z, key_sample = jax.random.split(key)

        def sample(key: Key[Array, ""], source: Int[Array, ""], recency: Float[Array, ""]) -> rp.Rollouts:
            return rp.sample_rollouts(
                replay,
                key,
                iteration,
                source=source,
                batch_size=batch,
                steps=config.rollout_steps,
                recent=recent,
                recency=recency,
            )

        sources = jnp.array([TARGET, GENERATED], jnp.int32)
        rollouts = jax.vmap(sample)(jax.random.split(key_sample), sources, jnp.stack([1.0, hparams.recency]))
        target, generated = (jax.tree.map(lambda x, source=source: x[source], rollouts) for source in (0, 1))
        z = noise(key_z, batch)

        def loss(models: Models) -> tuple[Float[Array, ""], tuple[Any, Any, Metrics]]:
            """All four objectives: each parameter group receives the gradient of its own alone."""
            loss_d, ((target_logit, generated_logit), spectral) = objectives.discriminator_loss(
                models.discriminator, state.spectral, target, generated, hparams
            )
            progress = jax.lax.stop_gradient(task_progress(generated_logit, relative=config.relative_progress))
            loss_1, progress_error = objectives.value_loss(models.progress_value, generated.w, progress)
            loss_2, return_error = objectives.value_loss(models.return_value, generated.w, generated.episode_return)
            ensembles = jax.lax.stop_gradient((models.progress_value, models.return_value))
            loss_g, (batch_stats, (progress_value, return_value)) = objectives.generator_loss(
                models.generator, state.batch_stats, z, ensembles, state.beta, hparams
            )
            metrics = {
                "discriminator_loss": loss_d,
                "discriminator_target_logit": jnp.mean(target_logit),
                "discriminator_generated_logit": jnp.mean(generated_logit),
                "discriminator_generated_spread": jnp.std(generated_logit),
                "discriminator_target_accuracy": jnp.mean(jnp.float32(target_logit > 0.0)),
                "discriminator_generated_accuracy": jnp.mean(jnp.float32(generated_logit < 0.0)),
                "v1_unexplained": jnp.mean(progress_error**2) / (jnp.var(progress) + 1e-6),
                "v2_unexplained": jnp.mean(return_error**2) / (jnp.var(generated.episode_return) + 1e-6),
                "generator_progress": progress_value,
                "generator_return": return_value,
            }
            return loss_d + loss_1 + loss_2 + loss_g, (batch_stats, spectral, metrics)

        grads, (batch_stats, spectral, metrics) = jax.grad(loss, has_aux=True)(state.models)
        direction, opt_state = ADAM.update(grads, state.opt_state)
        rates = Models(
            generator=hparams.generator_learning_rate,
            discriminator=hparams.discriminator_learning_rate,
            progress_value=hparams.value_learning_rate,
            return_value=hparams.value_learning_rate,
        )
        models = Models(*map(descend, state.models, direction, rates))
        shrink = 1.0 - hparams.value_learning_rate * hparams.value_weight_decay
        models = models._replace(
            progress_value=jax.tree.map(lambda p: p * shrink, models.progress_value),
            return_value=jax.tree.map(lambda p: p * shrink, models.return_value),
        )
        return AptGenState(models, opt_state, batch_stats, spectral, state.beta), metrics

    def refresh(
        state: AptGenState, key: Key[Array, ""], replay: rp.Replay, iterations: Int[Array, ""], hparams: HParams
    ) -> AptGenState:
        del key, iterations
        outcome = rp.recent_outcome(replay, source=GENERATED, window=config.return_window, since=warm)
        proportional = partial(proportional_beta, neutral=hparams.beta_init)
        follow: Callable[..., Float[Array, ""]] = proportional if config.beta_rule == "proportional" else adapt_beta
        beta = follow(
            state.beta,
            outcome["episode_return"],
            delta=hparams.delta,
            tolerance=hparams.tolerance,
            low=hparams.beta_min,
            high=hparams.beta_max,
        )
        return state._replace(beta=beta)

    def report(state: AptGenState, rollouts: rp.Rollouts, hparams: HParams) -> Metrics:
        said = judge(objectives, state, rollouts, hparams)
        progress = task_progress(said.logit, relative=config.relative_progress)
        return {
            "beta": state.beta,
            "probe_logit": jnp.mean(said.logit),
            "v1_correlation": correlation(said.progress, progress),
            "v2_correlation": correlation(said.value, rollouts.episode_return),
            "v2_bias": jnp.mean(said.value - rollouts.episode_return),
        }

    return Curriculum(True, init, propose, update, refresh, report)


class Judgement(NamedTuple):
    """What the models say of rollouts and of their tasks: D's pooled logit, V1 and V2 (the ensembles' means)."""

    logit: Float[Array, "n"]
    progress: Float[Array, "n"]
    value: Float[Array, "n"]


def judge(objectives: Objectives, state: AptGenState, rollouts: rp.Rollouts, hparams: HParams) -> Judgement:
    """Asks the models about n rollouts."""
    discriminator, _ = spectral_normalize(state.models.discriminator, state.spectral, bound=hparams.spectral_bound)
    progress, value = (
        jnp.mean(objectives.evaluate(ensemble, rollouts.w), axis=0)
        for ensemble in (state.models.progress_value, state.models.return_value)
    )
    return Judgement(objectives.score(discriminator, rollouts), progress, value)


def explore(spec: Spec, w: Params, key: Key[Array, ""], hparams: HParams) -> Params:
    """Exploration noise on generated tasks (leaves [n, ...]), as an actor's actions get; consumes `key`.

    The value networks can only tell the generator which way to go where tasks were played that differ in that direction.
    """
    explored = {}
    for (name, modality), key_block in zip(spec.items(), jax.random.split(key, len(spec)), strict=True):
        block = w[name]
        if isinstance(modality, Vector):
            spread = hparams.vector_noise * (modality.high - modality.low)
            noisy = block + spread * jax.random.normal(key_block, block.shape)
            explored[name] = jnp.clip(noisy, modality.low, modality.high)
        else:
            chance, scores = jnp.split(draws.uniform(key_block, (*block.shape[:-1], 1 + block.shape[-1])), [1], axis=-1)
            explored[name] = jnp.where(chance < hparams.cell_noise, scores, block)
    return explored


def correlation(a: Float[Array, "n"], b: Float[Array, "n"]) -> Float[Array, ""]:
    """Pearson correlation, 0 where either side is constant up to rounding; on any scale, as values near 0 are squared late."""

    def direction(x: Float[Array, "n"]) -> Float[Array, "n"]:
        """Of unit length, or 0."""
        centred = x - jnp.mean(x)
        largest = jnp.max(jnp.abs(centred))
        varies = largest > 1e-6 * jnp.max(jnp.abs(x))
        centred = centred / jnp.where(varies, largest, 1.0)
        return jnp.where(varies, centred / jnp.linalg.norm(jnp.where(varies, centred, 1.0)), 0.0)

    return jnp.sum(direction(a) * direction(b))
