"""RND: paid for states on which a network has not yet learned a fixed random function (Burda et al. 2019)."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from apt_jax.bonuses.base import Bonus, Step, Steps
from apt_jax.bonuses.learned import Moves, leading, learned
from apt_jax.bonuses.moments import Moments
from apt_jax.config import Config, HParams
from apt_jax.networks import Distillation
from apt_jax.networks.apply import apply
from apt_jax.networks.encoders import Features, observation_features
from apt_jax.plugin import Metrics
from apt_jax.specs import Obs, obs_struct, zeros_like
from apt_jax.task_space import TaskSpace

DISCOUNT = 0.99
"""Of the return whose deviation is the bonus's unit."""

CLIP = 5.0
"""Bound of normalised observations, in deviations."""

FEW = 10
"""Bonuses seen before their deviation is the unit, until then 1: a single environment's first one deviates by nothing."""

EPSILON = 1e-8
"""Added to variances: some inputs never change."""


class RndMemory(NamedTuple):
    """The fixed network, and running statistics, all of them taken when steps are made.

    `filtered` is each environment's forward-filtered return of bonuses, across episodes, since the predictor's first update;
    `scale` holds its moments.  What an untrained predictor pays in the warm-up would outweigh all that it pays later.
    """

    target: Any
    features: dict[str, Moments]
    filtered: Float[Array, "S E"]
    scale: Moments


def make(space: TaskSpace, config: Config) -> Bonus:
    """Mean squared error of the predictor, over the deviation of its filtered return, times `HParams.rnd_scale`.

    Observations are normalised by what has been seen since the first, uniformly random, step.  Otherwise than in the reference,
    one Q-function learns both rewards under the policy's discount, a termination ends both, and the predictor learns from
    uniform draws of the replay in every round of model updates, so novelty wears off sooner: lower `bonus_learning_rate` or
    `Config.model_updates_per_step` for more of it.
    """
    target_network = Distillation(space.obs_spec, deeper=False)
    predictor_network = Distillation(space.obs_spec, deeper=True)

    def init(key: Key[Array, ""], states: Any) -> tuple[Any, RndMemory]:
        key_target, key_predictor = jax.random.split(key)
        features = observation_features(space.obs_spec, zeros_like(obs_struct(space.obs_spec)))
        memory = RndMemory(
            target=target_network.init(key_target, features),
            features={name: Moments.start(block.shape) for name, block in features.items()},
            filtered=jnp.zeros(leading(states)),
            scale=Moments.start(),
        )
        return predictor_network.init(key_predictor, features), memory

    def error(params: Any, memory: RndMemory, next_obs: Obs) -> Float[Array, "..."]:
        features = normalise(memory.features, observation_features(space.obs_spec, next_obs))
        wanted = jax.lax.stop_gradient(apply(target_network, memory.target, features))
        return jnp.mean((apply(predictor_network, params, features) - wanted) ** 2, axis=-1)

    def observe(params: Any, memory: RndMemory, step: Step, learning: Bool[Array, ""]) -> tuple[RndMemory, Any]:
        features = observation_features(space.obs_spec, step.transition.next_obs)
        flat = {name: block.reshape(-1, *block.shape[2:]) for name, block in features.items()}
        memory = memory._replace(features={name: memory.features[name].extend(block) for name, block in flat.items()})
        filtered = forward_filter(memory.filtered, error(params, memory, step.transition.next_obs))
        filtered, scale = jax.tree.map(
            partial(jnp.where, learning), (filtered, memory.scale.extend(filtered.reshape(-1))), (memory.filtered, memory.scale)
        )
        return memory._replace(filtered=filtered, scale=scale), ()

    def price(params: Any, memory: RndMemory, steps: Steps, hparams: HParams) -> Float[Array, "..."]:
        unit = jnp.where(memory.scale.samples < FEW, 1.0, jnp.sqrt(memory.scale.variance + EPSILON))
        return hparams.rnd_scale * error(params, memory, steps.next_obs) / unit

    def loss(params: Any, memory: RndMemory, moves: Moves) -> tuple[Float[Array, ""], Metrics]:
        mean = jnp.mean(error(params, memory, moves.next_obs))
        return mean, {"rnd_loss": mean}

    return learned(space, config, note=(), init=init, observe=observe, price=price, loss=loss)


def forward_filter(filtered: Float[Array, "S E"], bonus: Float[Array, "S E"]) -> Float[Array, "S E"]:
    """The discounted sum of all bonuses until now, never reset at an episode's end."""
    return DISCOUNT * filtered + bonus


def normalise(moments: dict[str, Moments], features: Features) -> Features:
    """Deviations from the mean, clipped, with any leading axes."""

    def block(moments: Moments, x: Float[Array, "..."]) -> Float[Array, "..."]:
        lead = (1,) * (x.ndim - moments.mean.ndim)
        mean, variance = (values.reshape(*lead, *values.shape) for values in (moments.mean, moments.variance))
        return jnp.clip((x - mean) / jnp.sqrt(variance + EPSILON), -CLIP, CLIP)

    return {name: block(moments[name], x) for name, x in features.items()}
