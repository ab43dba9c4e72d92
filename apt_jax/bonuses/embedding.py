"""What ICM and RIDE have in common: an embedding of observations that learns what actions do (Pathak et al. 2017)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Integer, Key

from apt_jax.bonuses.learned import LossFn, Moves
from apt_jax.networks import Dynamics
from apt_jax.networks.apply import apply
from apt_jax.plugin import Metrics
from apt_jax.specs import obs_struct, zeros_like


def init_dynamics(network: Dynamics, key: Key[Array, ""]) -> Any:
    """Fresh parameters; consumes `key`."""
    obs = zeros_like(obs_struct(network.obs_spec))
    return network.init(key, obs, jnp.int32(0), obs, detach=True)


def dynamics_loss(network: Dynamics, name: str, *, inverse_weight: float, forward_weight: float, detach: bool) -> LossFn:
    """The weighted sum of both `losses`, which are metrics named after the bonus.

    Args:
      detach: whether the embedding learns from the inverse loss alone.
    """

    def loss(params: Any, memory: Any, moves: Moves) -> tuple[Float[Array, ""], Metrics]:
        del memory
        logits, predicted, embedding = apply(network, params, *moves, detach=detach)
        inverse, forward = losses(logits, moves.action, predicted=predicted, embedding=embedding)
        total = inverse_weight * inverse + forward_weight * forward
        return total, {f"{name}_inverse_loss": inverse, f"{name}_forward_loss": forward}

    return loss


def losses(
    logits: Float[Array, "B A"], action: Integer[Array, "B"], *, predicted: Float[Array, "B d"], embedding: Float[Array, "B d"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Inverse loss (cross-entropy of the action) and forward loss."""
    inverse = optax.losses.softmax_cross_entropy_with_integer_labels(logits, action.astype(jnp.int32))
    return jnp.mean(inverse), jnp.mean(prediction_error(predicted, embedding))


def prediction_error(predicted: Float[Array, "*batch d"], embedding: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    """Half the squared distance."""
    return 0.5 * jnp.sum((predicted - embedding) ** 2, axis=-1)
