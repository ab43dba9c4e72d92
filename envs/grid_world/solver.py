"""Shortest solutions by breadth-first search over the agent's position and the keys it has taken."""

from __future__ import annotations

from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32

from envs.grid_world.board import (
    BLUE_DOOR,
    BLUE_KEY,
    EMPTY,
    GOAL,
    OBJECTS,
    START,
    YELLOW_DOOR,
    YELLOW_KEY,
    Task,
    footprints,
)
from envs.grid_world.dynamics import HORIZON, MOVES


def solution_length(task: Task) -> Float32[Array, ""]:
    """Steps of the shortest solution, in [1, HORIZON]; NaN if the goal cannot be reached in time or is the start tile.

    Floods four boards at once, one per set of taken keys; jittable, with a fixed number of expansions.
    """
    on = footprints(task.objects, task.present)
    walkable = _walkable(on, task)

    def expand(reached: Bool[Array, "2 2 10 10"], _: None) -> tuple[Bool[Array, "2 2 10 10"], Bool[Array, ""]]:
        # What rolls over an edge lands on the opposite border wall, which is never walkable.
        neighbours = [jnp.roll(reached, shift, axis) for shift in (1, -1) for axis in (-2, -1)]
        reached = reached | (walkable & jnp.any(jnp.stack(neighbours), axis=0))
        # The board without the key keeps the key's tile: taking a key closes no way, so this shortens no solution.
        reached = reached.at[1, :].set(reached[1, :] | (reached[0, :] & on[YELLOW_KEY][None]))
        reached = reached.at[:, 1].set(reached[:, 1] | (reached[:, 0] & on[BLUE_KEY][None]))
        return reached, jnp.any(reached & on[GOAL][None, None])

    start = jnp.zeros(walkable.shape, bool).at[0, 0, START[0], START[1]].set(True)
    _, solved = jax.lax.scan(expand, start, length=HORIZON)
    feasible = solved[-1] & ~on[GOAL][START]
    return jnp.where(feasible, 1.0 + jnp.argmax(solved).astype(jnp.float32), jnp.nan)


def _walkable(on: Bool[Array, "5 10 10"], task: Task) -> Bool[Array, "2 2 10 10"]:
    """Tiles an agent may enter, by [yellow key taken, blue key taken, row, column]; `on` are the objects' footprints."""
    taken = jnp.array([False, True])
    yellow_open = taken[:, None, None] | ~on[YELLOW_DOOR][None]
    blue_open = taken[:, None, None] | ~on[BLUE_DOOR][None]
    floor = task.tiles == EMPTY
    return floor[None, None] & yellow_open[:, None] & blue_open[None, :]


def solve(task: Task) -> list[int] | None:
    """Actions of a shortest solution, or None where `solution_length` is NaN; a search in plain Python, on the host."""
    tiles, objects, present = (np.asarray(array) for array in (task.tiles, task.objects, task.present))
    where = {index: (int(objects[index, 0]), int(objects[index, 1])) for index in range(OBJECTS) if present[index]}
    if where.get(GOAL) == START:
        return None

    nothing: frozenset[int] = frozenset()
    plans: dict[tuple[tuple[int, int], frozenset[int]], list[int]] = {(START, nothing): []}
    queue = deque(plans)
    while queue:
        (row, column), keys = node = queue.popleft()
        for action, (down, right) in enumerate(MOVES.tolist()):
            ahead = (row + down, column + right)
            closed = {where.get(door) for door, key in ((YELLOW_DOOR, YELLOW_KEY), (BLUE_DOOR, BLUE_KEY)) if key not in keys}
            if tiles[ahead] != EMPTY or ahead in closed:
                continue
            after = (ahead, keys | {key for key in (YELLOW_KEY, BLUE_KEY) if where.get(key) == ahead})
            if after in plans:
                continue
            plans[after] = [*plans[node], action]
            if ahead == where.get(GOAL):
                return plans[after] if len(plans[after]) <= HORIZON else None
            queue.append(after)
    return None
