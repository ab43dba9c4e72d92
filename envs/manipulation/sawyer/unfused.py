"""Programs that XLA for CPUs does not fuse into one.

XLA computes an intermediate value anew wherever it is used, if it takes it for cheap.  Along a chain of links, each placed by
the one before, the copies multiply: with seven links their places take 40 ms that otherwise take 4 us (jax 0.10.2).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax.extend import core

COSTLY = frozenset({"concatenate", "dot_general"})
"""What puts a link's place and inertia together from those of the one before: its results are computed once."""


def unfused(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function with an optimisation barrier behind every operation of `COSTLY` on CPU; its results are the same."""

    def barred(*args: Any) -> Any:
        program, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        return jax.tree.unflatten(jax.tree.structure(shapes), _run(program, jax.tree.leaves(args)))

    return barred


def _run(program: core.ClosedJaxpr, args: list[Any]) -> list[Any]:
    """Results of a program, operation by operation; calls are entered, loops are left as they are."""
    known = dict(zip(program.jaxpr.constvars, program.consts, strict=True))
    known |= dict(zip(program.jaxpr.invars, args, strict=True))

    def read(value: Any) -> Any:
        return value.val if isinstance(value, core.Literal) else known[value]

    for operation in program.jaxpr.eqns:
        name, inputs = operation.primitive.name, [read(value) for value in operation.invars]
        inside = operation.params.get("jaxpr" if name in ("jit", "pjit") else "call_jaxpr")
        if isinstance(inside, core.ClosedJaxpr):
            results = _run(inside, inputs)
        else:
            results = operation.primitive.bind(*inputs, **operation.params)
            results = results if operation.primitive.multiple_results else [results]
        if name in COSTLY:
            results = jax.lax.platform_dependent(*results, cpu=_barrier, default=_as_it_is)
        known |= dict(zip(operation.outvars, results, strict=True))
    return [read(value) for value in program.jaxpr.outvars]


def _barrier(*results: Any) -> list[Any]:
    return jax.lax.optimization_barrier(list(results))


def _as_it_is(*results: Any) -> list[Any]:
    return list(results)
