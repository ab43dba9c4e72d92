"""A matmul whose weights' gradient is not slowed down by a transposed operand on CPU.

There XLA has fast kernels for products of rows by columns, and slow ones where the left factor has to be transposed, as in the
weights' gradient x^T g: up to four times the time, for what the networks here multiply (experiments/NOTES.md, section 31).
Copying a transposed factor first costs less, but XLA would merge that with the product again, unless told not to.
"""

from __future__ import annotations

from math import prod

import jax
from jax import lax
from jaxtyping import Array, Float

_VECTOR = 16
"""float32 numbers in a register; inputs of another width are as fast without being copied."""


def matmul(x: Float[Array, "*batch inputs"], w: Float[Array, "inputs outputs"]) -> Float[Array, "*batch outputs"]:
    """`x @ w` for any leading batch axes, differentiable once, in reverse."""
    *batch, inputs = x.shape
    rows = x.reshape(prod(batch), inputs)
    y = rows @ w if inputs % _VECTOR else _product(rows, w)
    return y.reshape(*batch, w.shape[1])


@jax.custom_vjp
def _product(x: Float[Array, "n inputs"], w: Float[Array, "inputs outputs"]) -> Float[Array, "n outputs"]:
    return x @ w


def _forward(x: Float[Array, "n inputs"], w: Float[Array, "inputs outputs"]) -> tuple[Array, tuple[Array, Array]]:
    return x @ w, (x, w)


def _backward(factors: tuple[Array, Array], g: Float[Array, "n outputs"]) -> tuple[Array, Array]:
    gradients: tuple[Array, Array] = lax.platform_dependent(*factors, g, cpu=_with_copies, default=_plain)
    return gradients


_product.defvjp(_forward, _backward)


def _plain(x: Array, w: Array, g: Array) -> tuple[Array, Array]:
    return g @ w.T, x.T @ g


def _with_copies(x: Array, w: Array, g: Array) -> tuple[Array, Array]:
    # Not merged with the sum that follows where an ensemble shares its rows: that takes ten times their products' time.
    return _copy(g @ w.T), _transposed_first(x, g)


def _transposed_first(x: Float[Array, "n inputs"], g: Float[Array, "n outputs"]) -> Float[Array, "inputs outputs"]:
    """x^T g with a copy of x^T, or as (g^T x)^T with copies of both transposed if these are smaller."""
    (n, inputs), outputs = x.shape, g.shape[1]
    if n * inputs <= (n + inputs) * outputs:
        return _copy(x.T) @ g
    return _copy(_copy(_copy(g).T) @ x).T


_copy = lax.optimization_barrier
"""Keeps XLA from merging what comes before with what comes after."""
