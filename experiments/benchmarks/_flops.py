"""Floating-point operations: of a function, and per second of this machine's matmuls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from math import prod
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jax.extend.core import Jaxpr, jaxprs_in_params
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Array, Float

from experiments.benchmarks._measure import Timing, time_loop

Shape: TypeAlias = tuple[int, int, int]
"""Rows, inner size and columns of a matmul."""


def matmuls(function: Callable[..., Any], *args: Any) -> Counter[Shape]:
    """How often one call of a function multiplies matrices of which shape.

    What nothing uses is not computed, and does not count; of a condition's branches the costliest one does.
    """
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    used, _ = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return _count(used)


def matmul_flops(function: Callable[..., Any], *args: Any) -> int:
    """Operations of every matmul in one call of a function, a multiply-add counted as two."""
    return _flops(matmuls(function, *args))


def compiled_flops(function: Callable[..., Any], *args: Any) -> float:
    """All operations of one call as the compiler estimates them; it counts the body of a loop once."""
    analysis: Any = jax.jit(function).lower(*args).compile().cost_analysis()
    return float(analysis["flops"])


def time_matmuls(rows: int, inner: int, columns: int, *, repeats: int, at_least: float) -> tuple[Timing, int]:
    """Times [rows, inner] x [inner, columns] and back again by [columns, inner], each result the next one's input.

    Returns:
      The time of such a pair, and its operations.
    """
    # Orthonormal columns or rows: the product does not grow, however often it is repeated.
    key_x, key_q = jax.random.split(jax.random.key(0))
    tall, _ = jnp.linalg.qr(jax.random.normal(key_q, (max(inner, columns), min(inner, columns))))
    there = tall if inner >= columns else tall.T
    matrices = there, jnp.copy(there.T)

    def pair(x: Float[Array, "rows inner"], matrices: tuple[Array, Array]) -> Float[Array, "rows inner"]:
        return x @ matrices[0] @ matrices[1]

    x = jax.random.normal(key_x, (rows, inner))
    return time_loop(pair, x, matrices, repeats=repeats, at_least=at_least), matmul_flops(pair, x, matrices)


def _count(jaxpr: Jaxpr) -> Counter[Shape]:
    total: Counter[Shape] = Counter()
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracting, _), (batch, _) = equation.params["dimension_numbers"]
            left: Any = equation.invars[0].aval
            out: Any = equation.outvars[0].aval
            copies, inner = (prod(left.shape[axis] for axis in axes) for axes in (batch, contracting))
            rows = prod(left.shape) // (copies * inner)
            total[rows, inner, prod(out.shape) // (copies * rows)] += copies
        runs = equation.params["length"] if equation.primitive.name == "scan" else 1
        subs = [_count(sub) for sub in jaxprs_in_params(equation.params)]
        for sub in [max(subs, key=_flops)] if equation.primitive.name == "cond" else subs:
            total.update({shape: runs * count for shape, count in sub.items()})
    return total


def _flops(counts: Counter[Shape]) -> int:
    return sum(2 * prod(shape) * count for shape, count in counts.items())
