"""Lanes that do not all fit the devices' memory: groups of them take turns, the others wait in the host's."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from apt_jax.trainer import Clock


@dataclass(frozen=True)
class Turns:
    """A function of G lanes made one of L: called for every G of them, one call after the other.

    Arguments and results have leaves [L, ...], but for the clock, which all lanes share.  Results are on the host's first CPU
    device: at any time the devices hold no more than a group.  The host holds three times all lanes at the end of a call: what
    went in, the groups' results, and these joined.

    Attributes:
      function: jitted, of arrays with leaves [G, ...], or what `lower` and `compile` made of it.
      lanes: L.
      group: G.
      mesh: the devices that each group is spread over, on an axis "lane".
    """

    function: Any
    lanes: int
    group: int
    mesh: Mesh

    def __call__(self, *args: Any) -> Any:
        """The results of all groups; raises a ValueError for another number of lanes (`check_lanes`)."""
        self._check(args)
        host = NamedSharding(Mesh(np.array(jax.devices("cpu")[:1]), ("lane",)), PartitionSpec("lane"))
        groups = []
        for start in range(0, self.lanes, self.group):
            results = _each(lambda tree: jax.device_put(tree, host), self.function(*self._take(start, args)))
            groups.append(jax.block_until_ready(results))  # the next group needs this one's room

        def join(*trees: Any) -> Any:
            joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[: self.lanes], *trees)
            return jax.device_put(joined, host)

        return _each(join, *groups)

    def lower(self, *args: Any) -> Turns:
        """As of a jitted function."""
        self._check(args)
        return dataclasses.replace(self, function=self.function.lower(*self._take(0, args)))

    def compile(self) -> Turns:
        """As of a lowered one."""
        return dataclasses.replace(self, function=self.function.compile())

    def _check(self, args: tuple[Any, ...]) -> None:
        for arg in args:
            if not isinstance(arg, Clock):
                check_lanes(arg, self.lanes)

    def _take(self, start: int, args: tuple[Any, ...]) -> tuple[Any, ...]:
        """The arguments of the group that begins with lane `start`, on its devices; the very last lane fills the last group."""
        rows = np.minimum(np.arange(start, start + self.group), self.lanes - 1)
        shared, lane = (NamedSharding(self.mesh, spec) for spec in (PartitionSpec(), PartitionSpec("lane")))

        def take(arg: Any) -> Any:
            if isinstance(arg, Clock):
                return jax.device_put(arg, shared)
            return jax.device_put(jax.tree.map(lambda x: x[rows], arg), lane)

        return tuple(map(take, args))


def check_lanes(tree: Any, lanes: int) -> None:
    """Raises a ValueError for a leaf without [lanes, ...]: JAX would repeat the last lane, or leave some out, in silence."""
    for leaf in jax.tree.leaves(tree):
        if np.shape(leaf)[:1] != (lanes,):
            raise ValueError(f"a program of {lanes} lanes needs arrays [{lanes}, ...], got one of shape {np.shape(leaf)}")


def _each(function: Callable[..., Any], *results: Any) -> Any:
    """What `function` makes of results, or of each of several together; of clocks the last stays as it is."""
    if isinstance(results[0], tuple) and not hasattr(results[0], "_fields"):
        return tuple(_each(function, *parts) for parts in zip(*results, strict=True))
    return results[-1] if isinstance(results[0], Clock) else function(*results)
