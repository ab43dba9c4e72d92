"""ICM: paid for what the agent cannot predict (Pathak et al. 2017)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Integer, Key

from apt_jax.bonuses.base import Bonus, Step, Steps
from apt_jax.bonuses.learned import Moves, learned
from apt_jax.config import Config, HParams
from apt_jax.networks import Dynamics
from apt_jax.networks.apply import apply
from apt_jax.plugin import Metrics
from apt_jax.specs import obs_struct, zeros_like
from apt_jax.task_space import TaskSpace


def make(space: TaskSpace, config: Config) -> Bonus:
    """Half the squared error of the predicted embedding, times `HParams.icm_scale`.

    The embedding learns from the inverse loss alone, the forward model from the other: they share no parameter, so the paper's
    weights of the two (0.8 and 0.2) would change nothing under Adam.
    """
    network = Dynamics(space.obs_spec, space.num_actions)

    def init(key: Key[Array, ""], states: Any) -> tuple[Any, Any]:
        del states
        obs = zeros_like(obs_struct(space.obs_spec))
        return network.init(key, obs, jnp.int32(0), obs, detach=True), ()

    def observe(params: Any, memory: Any, step: Step, learning: Bool[Array, ""]) -> tuple[Any, Any]:
        del params, step, learning
        return memory, ()

    def price(params: Any, memory: Any, steps: Steps, hparams: HParams) -> Float[Array, "..."]:
        del memory
        _, predicted, embedding = apply(network, params, steps.obs, steps.action, steps.next_obs, detach=True)
        return hparams.icm_scale * prediction_error(predicted, embedding)

    def loss(params: Any, memory: Any, moves: Moves) -> tuple[Float[Array, ""], Metrics]:
        del memory
        logits, predicted, embedding = apply(network, params, *moves, detach=True)
        inverse, forward = losses(logits, moves.action, predicted=predicted, embedding=embedding)
        return inverse + forward, {"icm_inverse_loss": inverse, "icm_forward_loss": forward}

    return learned(space, config, note=(), init=init, observe=observe, price=price, loss=loss)


def prediction_error(predicted: Float[Array, "*batch d"], embedding: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    """Half the squared distance."""
    return 0.5 * jnp.sum((predicted - embedding) ** 2, axis=-1)


def losses(
    logits: Float[Array, "B A"], action: Integer[Array, "B"], *, predicted: Float[Array, "B d"], embedding: Float[Array, "B d"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Inverse loss (cross-entropy of the action) and forward loss."""
    inverse = optax.losses.softmax_cross_entropy_with_integer_labels(logits, action.astype(jnp.int32))
    return jnp.mean(inverse), jnp.mean(prediction_error(predicted, embedding))
