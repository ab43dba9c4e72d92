"""Running mean and variance of a stream of numbers."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

MOST = 1e7
"""Samples that count at most; float32 has no number for 2^24 + 1 of them.  From there on the latest weigh a little more."""


class Moments(NamedTuple):
    """Mean, variance and number of the samples so far, up to `MOST`; before the first 0, 1 and almost none."""

    mean: Float[Array, "..."]
    variance: Float[Array, "..."]
    samples: Float[Array, ""]

    @classmethod
    def start(cls, shape: tuple[int, ...] = ()) -> Moments:
        """For samples of some shape."""
        return cls(jnp.zeros(shape), jnp.ones(shape), jnp.float32(1e-4))

    def extend(self, new: Float[Array, "n ..."]) -> Moments:
        """With n more samples (Chan et al. 1979)."""
        n = jnp.float32(new.shape[0])
        before = jnp.minimum(self.samples, MOST - n)
        total = before + n
        shift = jnp.mean(new, axis=0) - self.mean
        squares = self.variance * before + jnp.var(new, axis=0) * n + shift**2 * (before * n / total)
        return Moments(self.mean + shift * (n / total), squares / total, total)
