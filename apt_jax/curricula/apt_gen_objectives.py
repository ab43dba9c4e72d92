"""What each network of APT-Gen is trained on, as pure functions of parameters and data (paper, Sec. 3.2 and 3.3)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from apt_jax import losses
from apt_jax import replay as rp
from apt_jax.config import Config, HParams
from apt_jax.networks import (
    Discriminator,
    Generator,
    ValueNetwork,
    pool,
    pool_probabilities,
    spectral_normalize,
    vector_divergence,
)
from apt_jax.networks.apply import apply
from apt_jax.specs import Params, Spec, Vector
from apt_jax.task_space import TaskSpace


class Networks(NamedTuple):
    """G, D, and the network that both V1 and V2 are ensembles of."""

    generator: Generator
    discriminator: Discriminator
    value: ValueNetwork


class Objectives(NamedTuple):
    """Losses to be descended, each by its own parameters alone, and what they are made of.

    Attributes:
      networks: the modules that the parameters below belong to.
      generate: `generate(params, batch_stats, z) -> (w, batch_stats)`: tasks of noise [n, noise_size] under the batch's own
        statistics, and the running statistics moved towards them.
      score: `score(params, rollouts) -> logits [B]`: the discriminator's pooled logit of each rollout, from parameters that are
        spectrally normalised already.
      evaluate: `evaluate(ensemble, w) -> values [K, n]`: what each network of an ensemble says of tasks (leaves [n, ...]).
      discriminator_loss: `discriminator_loss(params, spectral, target, generated, hparams) -> (loss, (logits, spectral))`, for
        rollouts of both sources, logits of the target's and the generated ones, and the power iteration's vectors.
      value_loss: `value_loss(ensemble, w, outcome) -> (loss, errors [K, B])`, for outcomes [B] of tasks w (leaves [B, ...]).
      generator_loss: `generator_loss(params, batch_stats, z, ensembles, beta, hparams) -> (loss, (batch_stats, values))`, for
        the ensembles of V1 and V2, and the mean of each over the batch.
    """

    networks: Networks
    generate: Callable[..., tuple[Params, Any]]
    score: Callable[[Any, rp.Rollouts], Float[Array, "B"]]
    evaluate: Callable[[Any, Params], Float[Array, "K n"]]
    discriminator_loss: Callable[..., tuple[Float[Array, ""], Any]]
    value_loss: Callable[..., tuple[Float[Array, ""], Any]]
    generator_loss: Callable[..., tuple[Float[Array, ""], Any]]


def make_objectives(
    space: TaskSpace, config: Config, *, progress_weight: float = 1.0, return_weight: float = 1.0
) -> Objectives:
    """The objectives for the networks that a task space's specs call for; the generator's two terms may be weighted."""
    networks = Networks(
        Generator(space.param_spec, blank_bias=config.blank_bias),
        Discriminator(space.obs_spec, space.num_actions),
        ValueNetwork(space.param_spec),
    )

    def generate(params: Any, batch_stats: Any, z: Float[Array, "n z"]) -> tuple[Params, Any]:
        variables = {"params": params, "batch_stats": batch_stats}
        w, updated = apply(networks.generator, variables, z, train=True, mutable=["batch_stats"])
        return w, updated["batch_stats"]

    def judge(params: Any, rollouts: rp.Rollouts) -> tuple[Float[Array, "B"], Float[Array, "B k"]]:
        """The logits of each rollout's parts: its initial observation, its transitions."""
        steps = rollouts.steps
        initial = apply(networks.discriminator, params, rollouts.initial_obs, method="score_init")
        transitions = apply(
            networks.discriminator,
            params,
            steps.obs,
            steps.action,
            reward=steps.reward,
            next_obs=steps.next_obs,
            method="score_step",
        )
        return initial, transitions

    def pooled(initial: Float[Array, "B"], transitions: Float[Array, "B k"], length: Int[Array, "B"]) -> Float[Array, "B"]:
        return pool_probabilities(initial, transitions) if config.judge_parts else pool(initial, transitions, length)

    def score(params: Any, rollouts: rp.Rollouts) -> Float[Array, "B"]:
        return pooled(*judge(params, rollouts), rollouts.length)

    def evaluate(ensemble: Any, w: Params) -> Float[Array, "K n"]:
        size = jax.tree.leaves(ensemble)[0].shape[0]
        # A copy each: gradients of networks that share their rows XLA for CPUs transposes number by number.  Stacked, as the
        # sum that is `jnp.broadcast_to`'s gradient would be merged with a product, which takes ten times as long.
        seen = jax.tree.map(lambda x: jnp.stack([x] * size), as_instantiated(space.param_spec, w))
        return jax.vmap(partial(apply, networks.value))(ensemble, seen)

    def discriminator_loss(
        params: Any, spectral: Any, target: rp.Rollouts, generated: rp.Rollouts, hparams: HParams
    ) -> tuple[Float[Array, ""], Any]:
        normalised, spectral = spectral_normalize(params, spectral, bound=hparams.spectral_bound)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), target, generated)
        initial, transitions = judge(normalised, both)
        logits = pooled(initial, transitions, both.length)
        judged = (initial, transitions) if config.judge_parts else (logits,)
        loss = jnp.mean(jnp.stack([losses.discriminator_loss(*jnp.split(part, 2)) for part in judged]))
        return loss, (tuple(jnp.split(logits, 2)), spectral)

    def value_loss(ensemble: Any, w: Params, outcome: Float[Array, "B"]) -> tuple[Float[Array, ""], Any]:
        errors = evaluate(ensemble, w) - outcome[None]
        # A sum over the ensemble: how fast a network learns does not depend on how many there are.
        return jnp.sum(jnp.mean(errors**2, axis=1)), errors

    def generator_loss(
        params: Any,
        batch_stats: Any,
        z: Float[Array, "n z"],
        ensembles: tuple[Any, Any],
        beta: Float[Array, ""],
        hparams: HParams,
    ) -> tuple[Float[Array, ""], Any]:
        w, batch_stats = generate(params, batch_stats, z)
        progress, outcome = (pessimistic(evaluate(ensemble, w), hparams.pessimism) for ensemble in ensembles)
        objective = losses.generator_objective(
            progress_weight * progress, outcome, beta=return_weight * beta, delta=hparams.delta
        )
        prior = hparams.vector_prior * vector_divergence(space.param_spec, params)
        return prior - objective, (batch_stats, (jnp.mean(progress), jnp.mean(outcome)))

    return Objectives(networks, generate, score, evaluate, discriminator_loss, value_loss, generator_loss)


def as_instantiated(spec: Spec, w: Params) -> Params:
    """Replace category scores by the one-hot of their argmax, with the gradient of the scores (straight-through).

    A task shows nothing of its scores but their argmax, so this is what the value networks are to see.
    """

    def harden(name: str) -> Array:
        scores = w[name]
        if isinstance(spec[name], Vector):
            return scores
        one_hot = jax.nn.one_hot(jnp.argmax(scores, axis=-1), scores.shape[-1])
        return scores + jax.lax.stop_gradient(one_hot - scores)

    return {name: harden(name) for name in w}


def task_progress(logit: Float[Array, "n"], *, relative: bool) -> Float[Array, "n"]:
    """What V1 learns of the discriminator's logits of n generated rollouts, in [0, 1].

    D itself (paper).  If `relative`, logits are first centred and scaled to unit spread over the n: their
    order stays, and the weight of progress against return no longer depends on how far the discriminator has gone.
    """
    if relative:
        logit = (logit - jnp.mean(logit)) / (jnp.std(logit) + 1e-6)
    return jax.nn.sigmoid(logit)


def pessimistic(values: Float[Array, "K n"], pessimism: Float[Array, ""] | float) -> Float[Array, "n"]:
    """Mean of an ensemble less `pessimism` standard deviations: where the networks disagree there was little experience."""
    if values.shape[0] == 1:
        return values[0]
    spread = jnp.sqrt(jnp.var(values, axis=0) + 1e-8)  # the root has no gradient at zero
    return jnp.mean(values, axis=0) - pessimism * spread
