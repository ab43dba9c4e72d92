"""Random numbers drawn in a row and then given their shape, which compiles sooner.

XLA's CPU compiler takes 0.4 s for a draw of one axis and 2 s for one of four (experiments/NOTES.md, section 19).
"""

from __future__ import annotations

from math import prod

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key


def uniform(key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "..."]:
    """`jax.random.uniform(key, shape)`, number for number: floats in [0, 1); consumes `key`."""
    return jax.random.uniform(key, (prod(shape),)).reshape(shape)


def integers(key: Key[Array, ""], shape: tuple[int, ...], bound: Int[Array, "..."] | int) -> Int[Array, "..."]:
    """Integers in [0, bound), int32, for positive bounds that broadcast to `shape`; consumes `key`.

    One draw of 32 bits each, where `jax.random.randint` makes three to be more even: here the chance of a number is off by up
    to bound / 2^32 of itself.
    """
    bits = jax.random.bits(key, (prod(shape),), jnp.uint32).reshape(shape)
    return (bits % jnp.broadcast_to(jnp.asarray(bound, jnp.uint32), shape)).astype(jnp.int32)
