"""APT-Gen: a generator trained through a progress value and a return value (paper, Algorithm 1)."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key

from apt_jax import replay as rp
from apt_jax.config import Config, HParams
from apt_jax.curricula.base import GENERATED, TARGET, Curriculum, Metrics
from apt_jax.losses import adapt_beta, discriminator_loss, generator_objective
from apt_jax.networks import Discriminator, Generator, ValueNetwork, init_singular_vectors, pool, spectral_normalize
from apt_jax.networks.apply import apply
from apt_jax.specs import Grid, Params, Spec, obs_struct, param_struct, zeros_like
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


_ADAM = optax.flatten(optax.scale_by_adam())


def as_instantiated(spec: Spec, w: Params) -> Params:
    """Replace category scores by the one-hot of their argmax, with the gradient of the scores (straight-through).

    A task shows nothing of its scores but their argmax, so this is what the value networks are to see.
    """

    def harden(name: str) -> Array:
        scores = w[name]
        if not isinstance(spec[name], Grid):
            return scores
        one_hot = jax.nn.one_hot(jnp.argmax(scores, axis=-1), scores.shape[-1])
        return scores + jax.lax.stop_gradient(one_hot - scores)

    return {name: harden(name) for name in w}


def make(space: TaskSpace, config: Config) -> Curriculum:
    """The paper's curriculum."""
    generator = Generator(space.param_spec)
    discriminator = Discriminator(space.obs_spec, space.num_actions)
    value = ValueNetwork(space.param_spec)
    recent = config.recent_steps // config.envs_per_source
    batch = config.model_batch_size

    def noise(key: Key[Array, ""], n: int) -> Float[Array, "n z"]:
        return jax.random.normal(key, (n, config.noise_size))

    def generate(params: Any, batch_stats: Any, z: Float[Array, "n z"]) -> tuple[Params, Any]:
        """Tasks under the batch's own statistics, and the running statistics moved towards them."""
        variables = {"params": params, "batch_stats": batch_stats}
        w, updated = apply(generator, variables, z, train=True, mutable=["batch_stats"])
        return w, updated["batch_stats"]

    def score(params: Any, rollouts: rp.Rollouts) -> Float[Array, "B"]:
        """The discriminator's pooled logit of each rollout."""
        steps = rollouts.steps
        initial = apply(discriminator, params, rollouts.initial_obs, method="score_init")
        transitions = apply(
            discriminator, params, steps.obs, steps.action, reward=steps.reward, next_obs=steps.next_obs, method="score_step"
        )
        return pool(initial, transitions, rollouts.length)

    def evaluate(params: Any, w: Params) -> Float[Array, "K n"]:
        """What each network of an ensemble says of tasks (leaves [n, ...])."""
        return jax.vmap(lambda member: apply(value, member, as_instantiated(space.param_spec, w)))(params)

    def init_ensemble(key: Key[Array, ""]) -> Any:
        w = zeros_like(param_struct(space.param_spec))
        return jax.vmap(lambda key: value.init(key, w))(jax.random.split(key, config.value_ensemble))

    def init(key: Key[Array, ""], hparams: HParams) -> AptGenState:
        key_g, key_d, key_1, key_2, key_spectral, key_stats = jax.random.split(key, 6)
        variables = generator.init(key_g, jnp.zeros((2, config.noise_size)), train=True)
        obs = zeros_like(obs_struct(space.obs_spec))
        models = Models(
            generator=variables["params"],
            discriminator=discriminator.init(key_d, obs, jnp.int32(0), reward=jnp.float32(0.0), next_obs=obs),
            progress_value=init_ensemble(key_1),
            return_value=init_ensemble(key_2),
        )

        # The first tasks are drawn from running statistics, which must describe the fresh generator before it is used.
        def settle(stats: Any, z: Float[Array, "n z"]) -> tuple[Any, None]:
            return generate(models.generator, stats, z)[1], None

        z = noise(key_stats, 100 * batch).reshape(100, batch, config.noise_size)
        batch_stats, _ = jax.lax.scan(settle, variables["batch_stats"], z)
        return AptGenState(
            models=models,
            opt_state=_ADAM.init(models),
            batch_stats=batch_stats,
            spectral=init_singular_vectors(key_spectral, models.discriminator),
            beta=jnp.asarray(hparams.beta_init, jnp.float32),
        )

    def propose(state: AptGenState, key: Key[Array, ""], n: int, hparams: HParams) -> Params:
        key_z, key_explore = jax.random.split(key)
        variables = {"params": state.models.generator, "batch_stats": state.batch_stats}
        w = apply(generator, variables, noise(key_z, n), train=False)
        return explore(space.param_spec, w, key_explore, hparams)

    def update(
        state: AptGenState, key: Key[Array, ""], replay: rp.Replay, iteration: Int[Array, ""], hparams: HParams
    ) -> tuple[AptGenState, Metrics]:
        key_target, key_generated, key_z = jax.random.split(key, 3)

        def sample(key: Key[Array, ""], source: int) -> rp.Rollouts:
            return rp.sample_rollouts(
                replay,
                key,
                iteration,
                source=source,
                batch_size=batch,
                steps=config.rollout_steps,
                recent=recent,
            )

        target, generated = sample(key_target, TARGET), sample(key_generated, GENERATED)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), target, generated)
        z = noise(key_z, batch)

        def loss(models: Models) -> tuple[Float[Array, ""], tuple[Any, Any, Metrics]]:
            """All four objectives: each parameter group receives the gradient of its own alone."""
            params, spectral = spectral_normalize(models.discriminator, state.spectral, bound=hparams.spectral_bound)
            target_logit, generated_logit = jnp.split(score(params, both), 2)
            loss_d = discriminator_loss(target_logit, generated_logit)

            progress = jax.lax.stop_gradient(jax.nn.sigmoid(generated_logit / hparams.progress_temperature))
            progress_error = evaluate(models.progress_value, generated.w) - progress[None]
            return_error = evaluate(models.return_value, generated.w) - generated.episode_return[None]

            w, batch_stats = generate(models.generator, state.batch_stats, z)
            frozen = jax.lax.stop_gradient(models)
            progress_value = pessimistic(evaluate(frozen.progress_value, w), hparams.pessimism)
            return_value = pessimistic(evaluate(frozen.return_value, w), hparams.pessimism)
            objective = generator_objective(progress_value, return_value, beta=state.beta, delta=hparams.delta)
            metrics = {
                "discriminator_loss": loss_d,
                "discriminator_target_logit": jnp.mean(target_logit),
                "discriminator_generated_logit": jnp.mean(generated_logit),
                "discriminator_generated_spread": jnp.std(generated_logit),
                "discriminator_accuracy": 0.5
                * (jnp.mean(jnp.float32(target_logit > 0.0)) + jnp.mean(jnp.float32(generated_logit < 0.0))),
                "v1_unexplained": jnp.mean(progress_error**2) / (jnp.var(progress) + 1e-6),
                "v2_unexplained": jnp.mean(return_error**2) / (jnp.var(generated.episode_return) + 1e-6),
                "generator_progress": jnp.mean(progress_value),
                "generator_return": jnp.mean(return_value),
            }
            # Sums over the ensemble: each network has a loss of its own.
            loss_1 = jnp.sum(jnp.mean(progress_error**2, axis=1))
            loss_2 = jnp.sum(jnp.mean(return_error**2, axis=1))
            total = loss_d + loss_1 + loss_2 - objective
            return total, (batch_stats, spectral, metrics)

        grads, (batch_stats, spectral, metrics) = jax.grad(loss, has_aux=True)(state.models)
        direction, opt_state = _ADAM.update(grads, state.opt_state)
        rates = Models(
            generator=hparams.generator_learning_rate,
            discriminator=hparams.discriminator_learning_rate,
            progress_value=hparams.value_learning_rate,
            return_value=hparams.value_learning_rate,
        )
        models = Models(*map(_descend, state.models, direction, rates))
        shrink = 1.0 - hparams.value_learning_rate * hparams.value_weight_decay
        models = models._replace(
            progress_value=jax.tree.map(lambda p: p * shrink, models.progress_value),
            return_value=jax.tree.map(lambda p: p * shrink, models.return_value),
        )
        return AptGenState(models, opt_state, batch_stats, spectral, state.beta), metrics

    def refresh(state: AptGenState, replay: rp.Replay, hparams: HParams) -> AptGenState:
        outcome = rp.recent_outcome(replay, source=GENERATED, window=config.return_window)
        beta = adapt_beta(
            state.beta,
            outcome["episode_return"],
            delta=hparams.delta,
            tolerance=hparams.tolerance,
            low=hparams.beta_min,
            high=hparams.beta_max,
        )
        return state._replace(beta=beta)

    def report(state: AptGenState, w: Params, episode_return: Float[Array, "n"]) -> Metrics:
        predicted = jnp.mean(evaluate(state.models.return_value, w), axis=0)
        return {
            "beta": state.beta,
            "v2_correlation": correlation(predicted, episode_return),
            "v2_bias": jnp.mean(predicted - episode_return),
        }

    return Curriculum(True, init, propose, update, refresh, report)


def _descend(params: Any, direction: Any, rate: Float[Array, ""] | float) -> Any:
    return jax.tree.map(lambda p, d: p - rate * d, params, direction)


def explore(spec: Spec, w: Params, key: Key[Array, ""], hparams: HParams) -> Params:
    """Exploration noise on generated tasks (leaves [n, ...]), as an actor's actions get; consumes `key`.

    The value networks can only tell the generator which way to go where tasks were played that differ in that direction.
    """
    explored = {}
    for (name, modality), key_block in zip(spec.items(), jax.random.split(key, len(spec)), strict=True):
        block = w[name]
        key_noise, key_cell = jax.random.split(key_block)
        if isinstance(modality, Grid):
            scores = jax.random.uniform(key_noise, block.shape)
            replaced = jax.random.uniform(key_cell, block.shape[:-1]) < hparams.cell_noise
            explored[name] = jnp.where(replaced[..., None], scores, block)
        else:
            spread = hparams.vector_noise * (modality.high - modality.low)
            noisy = block + spread * jax.random.normal(key_noise, block.shape)
            explored[name] = jnp.clip(noisy, modality.low, modality.high)
    return explored


def pessimistic(values: Float[Array, "K n"], pessimism: Float[Array, ""] | float) -> Float[Array, "n"]:
    """Mean of an ensemble less `pessimism` standard deviations: where the networks disagree there was little experience."""
    if values.shape[0] == 1:
        return values[0]
    spread = jnp.sqrt(jnp.var(values, axis=0) + 1e-8)  # the root has no gradient at zero
    return jnp.mean(values, axis=0) - pessimism * spread


def correlation(a: Float[Array, "n"], b: Float[Array, "n"]) -> Float[Array, ""]:
    """Pearson correlation, 0 where either side is constant."""
    a, b = a - jnp.mean(a), b - jnp.mean(b)
    return jnp.sum(a * b) / (jnp.sqrt(jnp.sum(a**2) * jnp.sum(b**2)) + 1e-6)
