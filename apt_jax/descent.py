"""Gradient descent whose step size is an argument, so that it may differ from lane to lane of one compiled program."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import optax
from jaxtyping import Array, Bool, Float

Params = TypeVar("Params")

ADAM = optax.flatten(optax.scale_by_adam())
"""Adam's direction, of step size 1, with (0.9, 0.999) as the paper has it; on one flat vector, faster for small leaves."""


def descend(params: Params, direction: Params, rate: Float[Array, ""] | float) -> Params:
    """Parameters after a step of size `rate` against `direction`, a pytree like `params`."""
    return jax.tree.map(lambda p, d: p - rate * d, params, direction)


def adam_step(params: Params, opt_state: Any, grads: Params, rate: Float[Array, ""] | float) -> tuple[Params, Any]:
    """Parameters and Adam's state after a step of size `rate` against `grads`, a pytree like `params`."""
    direction, opt_state = ADAM.update(grads, opt_state)
    return descend(params, direction, rate), opt_state


def has_learned(opt_state: Any) -> Bool[Array, ""]:
    """Whether Adam has made a step."""
    return opt_state.count > 0
