"""Gaussian mixtures fitted by expectation-maximisation in shapes that do not depend on the number of components.

A mixture has K slots, of which the first k are in use.  Unused ones have no weight and a unit covariance; rows of data that do
not count have no responsibility.  The number of components is thus an array, over which one may `vmap` or `map`.  Steps and
stopping rule are scikit-learn's, so that from the same labels both arrive at the same mixture.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

TOLERANCE = 1e-3
"""Change of the mean log-likelihood below which a fit has converged."""

MAX_ITERATIONS = 100
LLOYD_ITERATIONS = 20


class Mixture(NamedTuple):
    """Weights, means, and lower Cholesky factors of the covariances."""

    weights: Float[Array, "K"]
    means: Float[Array, "K D"]
    scale_tril: Float[Array, "K D D"]


class Fit(NamedTuple):
    """A mixture, its Akaike information criterion, and the iterations it took; NaN where a covariance had no factor."""

    mixture: Mixture
    aic: Float[Array, ""]
    iterations: Int[Array, ""]


def fit(
    x: Float[Array, "N D"],
    valid: Bool[Array, "N"],
    labels: Int[Array, "N"],
    k: Int[Array, ""],
    *,
    slots: int,
    regularisation: Float[Array, ""] | float,
    diagonal: bool = False,
) -> Fit:
    """The mixture of `k` components that expectation-maximisation finds from the rows' first `labels`, each below k."""
    size = x.shape[1]
    rows = valid.astype(x.dtype)
    used = jnp.arange(slots, dtype=jnp.int32) < k
    identity = jnp.eye(size, dtype=x.dtype)
    floor = 10 * jnp.finfo(x.dtype).eps

    def maximise(responsibilities: Float[Array, "N K"]) -> Mixture:
        mass = jnp.sum(responsibilities, axis=0) + floor
        means = responsibilities.T @ x / mass[:, None]

        def factor(used: Array, mean: Array, share: Array, mass: Array) -> Array:
            apart = x - mean[None, :]
            covariance = (share[:, None] * apart).T @ apart / mass + regularisation * identity
            if diagonal:
                covariance = covariance * identity
            return jnp.linalg.cholesky(jnp.where(used, covariance, identity))

        return Mixture(mass / jnp.sum(mass), means, jax.vmap(factor)(used, means, responsibilities.T, mass))

    def expect(mixture: Mixture) -> tuple[Float[Array, "N K"], Float[Array, ""]]:
        """Responsibilities, and the mean log-likelihood of the rows that count."""
        joint = jnp.where(used[None, :], jnp.log(mixture.weights)[None, :] + log_density(mixture, x), -jnp.inf)
        likelihood = jax.nn.logsumexp(joint, axis=1)
        mean = jnp.sum(jnp.where(valid, likelihood, 0.0)) / jnp.sum(rows)
        return jnp.exp(joint - likelihood[:, None]) * rows[:, None], mean

    Carry = tuple[Mixture, Float[Array, ""], Float[Array, ""], Int[Array, ""]]

    def goes_on(carry: Carry) -> Bool[Array, ""]:
        _, previous, bound, iterations = carry
        changes = jnp.abs(bound - previous) >= TOLERANCE  # false of NaN
        return (iterations < 1) | (changes & (iterations < MAX_ITERATIONS))

    def iterate(carry: Carry) -> Carry:
        mixture, _, bound, iterations = carry
        responsibilities, likelihood = expect(mixture)
        return maximise(responsibilities), bound, likelihood, iterations + 1

    first = maximise(jax.nn.one_hot(labels, slots, dtype=x.dtype) * rows[:, None])
    unknown = jnp.asarray(-jnp.inf, x.dtype)
    mixture, _, _, iterations = jax.lax.while_loop(goes_on, iterate, (first, unknown, unknown, jnp.int32(0)))
    spread = size if diagonal else size * (size + 1) // 2
    parameters = (k * (size + spread + 1) - 1).astype(x.dtype)
    aic = 2.0 * parameters - 2.0 * expect(mixture)[1] * jnp.sum(rows)
    return Fit(mixture, aic, iterations)


def log_density(mixture: Mixture, x: Float[Array, "N D"]) -> Float[Array, "N K"]:
    """Of every row under every component."""

    def component(mean: Array, factor: Array) -> Array:
        whitened = invert_lower(factor) @ (x - mean[None, :]).T
        log_determinant = jnp.sum(jnp.log(jnp.diagonal(factor)))
        return -0.5 * (x.shape[1] * jnp.log(2 * jnp.pi) + jnp.sum(whitened**2, axis=0)) - log_determinant

    return jax.vmap(component)(mixture.means, mixture.scale_tril).T


def invert_lower(lower: Float[Array, "D D"]) -> Float[Array, "D D"]:
    """The inverse of a lower triangular matrix, from its diagonal in blocks of doubling size.

    In matmuls alone: a triangular solve in a `while_loop` hangs when two CPU devices run it at once (jax 0.10.2).
    """
    rows = lower.shape[0]
    lower = jnp.eye(1 << (rows - 1).bit_length(), dtype=lower.dtype).at[:rows, :rows].set(lower)
    inverses = (1.0 / jnp.diagonal(lower))[:, None, None]  # of the blocks along the diagonal
    while inverses.shape[0] > 1:
        pairs, size = inverses.shape[0] // 2, inverses.shape[1]
        at = np.arange(pairs)
        below = lower.reshape(pairs, 2, size, pairs, 2, size)[at, 1, :, at, 0, :]
        first, second = inverses[0::2], inverses[1::2]
        inverses = jnp.concatenate(
            (
                jnp.concatenate((first, jnp.zeros_like(first)), axis=2),
                jnp.concatenate((-second @ below @ first, second), axis=2),
            ),
            axis=1,
        )
    return inverses[0, :rows, :rows]


def draw(mixture: Mixture, logits: Float[Array, "K"], key: Key[Array, ""]) -> Float[Array, "D"]:
    """A row of a component drawn by `logits`, whatever the mixture's weights; consumes `key`."""
    key_component, key_normal = jax.random.split(key)
    component = jax.random.categorical(key_component, logits)
    mean = mixture.means[component]
    return mean + mixture.scale_tril[component] @ jax.random.normal(key_normal, mean.shape, mean.dtype)


def k_means(x: Float[Array, "N D"], valid: Bool[Array, "N"], k: Int[Array, ""], key: Key[Array, ""], *, slots: int) -> Array:
    """Labels [N] by k-means, its centres first spread over the rows by k-means++; consumes `key`."""
    used = jnp.arange(slots, dtype=jnp.int32) < k

    def distances(centres: Float[Array, "K D"]) -> Float[Array, "N K"]:
        squares = jnp.sum((x[:, None, :] - centres[None, :, :]) ** 2, axis=-1)
        return jnp.where(used[None, :], squares, jnp.inf)

    def spread(
        carry: tuple[Float[Array, "K D"], Float[Array, "N"], Key[Array, ""]], slot: Int[Array, ""]
    ) -> tuple[tuple[Float[Array, "K D"], Float[Array, "N"], Key[Array, ""]], None]:
        """Draws a row in proportion to its squared distance from the nearest centre so far."""
        centres, nearest, key = carry
        key, key_row = jax.random.split(key)
        logits = jnp.where(valid, jnp.log(nearest + jnp.finfo(x.dtype).tiny), -jnp.inf)
        centre = x[jax.random.categorical(key_row, logits)]
        nearest = jnp.minimum(nearest, jnp.sum((x - centre[None, :]) ** 2, axis=-1))
        return (centres.at[slot].set(centre), nearest, key), None

    def move(centres: Float[Array, "K D"], _: None) -> tuple[Float[Array, "K D"], None]:
        near = jax.nn.one_hot(jnp.argmin(distances(centres), axis=-1), slots, dtype=x.dtype) * valid[:, None].astype(x.dtype)
        count = jnp.sum(near, axis=0)[:, None]
        return jnp.where(count > 0, near.T @ x / jnp.maximum(count, 1.0), centres), None

    nowhere = jnp.full(x.shape[0], jnp.finfo(x.dtype).max)
    start = jnp.zeros((slots, x.shape[1]), x.dtype), nowhere, key
    (centres, _, _), _ = jax.lax.scan(spread, start, jnp.arange(slots, dtype=jnp.int32))
    centres, _ = jax.lax.scan(move, centres, length=LLOYD_ITERATIONS)
    return jnp.argmin(distances(centres), axis=-1)
