"""Floating-point operations: of a function, and per second of this machine's matmuls."""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Jaxpr, jaxprs_in_params
from jaxtyping import Array, Float

from experiments.benchmarks._measure import Timing, time_loop


def matmul_flops(function: Callable[..., Any], *args: Any) -> int:
    """Operations of every matmul in one call of a function, a multiply-add counted as two."""
    return _count(jax.make_jaxpr(function)(*args).jaxpr)


def compiled_flops(function: Callable[..., Any], *args: Any) -> float:
    """All operations of one call as the compiler estimates them; it counts the body of a loop once."""
    analysis: Any = jax.jit(function).lower(*args).compile().cost_analysis()
    return float(analysis["flops"])


def time_matmuls(rows: int, inner: int, columns: int, *, repeats: int, at_least: float) -> tuple[Timing, int]:
    """Times [rows, inner] x [inner, columns] and back again by [columns, inner], each result the next one's input.

    Returns:
      The time of such a pair, and its operations.
    """
    # Orthonormal columns: the product neither grows nor fades, however often it is repeated.
    key_x, key_q = jax.random.split(jax.random.key(0))
    there, _ = jnp.linalg.qr(jax.random.normal(key_q, (inner, columns)))
    matrices = there, jnp.copy(there.T)

    def pair(x: Float[Array, "rows inner"], matrices: tuple[Array, Array]) -> Float[Array, "rows inner"]:
        return x @ matrices[0] @ matrices[1]

    x = jax.random.normal(key_x, (rows, inner))
    return time_loop(pair, x, matrices, repeats=repeats, at_least=at_least), matmul_flops(pair, x, matrices)


def _count(jaxpr: Jaxpr) -> int:
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracting, _), _ = equation.params["dimension_numbers"]
            left: Any = equation.invars[0].aval
            out: Any = equation.outvars[0].aval
            total += 2 * prod(out.shape) * prod(left.shape[axis] for axis in contracting)
        inner = sum(_count(sub) for sub in jaxprs_in_params(equation.params))
        total += inner * (equation.params["length"] if equation.primitive.name == "scan" else 1)
    return total
