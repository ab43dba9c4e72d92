"""Shortest solutions by breadth-first search over the places that pushes take the cans to.

Each can is first pushed about alone, in the simulation: that gives the places it can reach and the pushes between them.
The search then runs over places of all cans at once, where a push must stay clear of the other cans.
"""

from __future__ import annotations

from collections import deque
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs.manipulation.dynamics import GOAL_RADIUS, HORIZON
from envs.manipulation.push import TOOL_RADIUS, TOOL_START, Outcome, push
from envs.manipulation.table import ABSENT, CAN_RADIUS, CANS, DIRECTIONS, TARGET, Task

SAME_PLACE = 0.01
SPARE = 0.005
"""Places this close are one; pushes keep this much more from other cans than they need."""

BATCH = 16
"""Places pushed from at once."""


class Roads(NamedTuple):
    """Where one can gets to when it is alone.

    Attributes:
      places: (x, y), the first one where it starts.
      leads: index of the place that a push in each direction leads to; -1 if it ends the episode.
    """

    places: Float[np.ndarray, "n 2"]
    leads: Int[np.ndarray, "n 4"]


def solve(task: Task, jitter: float = 0.0) -> list[int] | None:
    """Actions of a shortest solution, wherever the goal's centre is drawn within `jitter` along x and y; on the host.

    None if there is none within the horizon that keeps `SPARE` from other cans.  The search takes places to be exact that
    are so to `SAME_PLACE`: replay a solution before relying on it.
    """
    task = jax.device_get(task)
    if not task.present[TARGET]:
        return None
    roads = [explore(task, can) for can in range(CANS) if task.present[can]]
    clear = {(a, b): clearances(roads[a], roads[b]) for a in range(len(roads)) for b in range(len(roads)) if a != b}
    off = np.abs(roads[TARGET].places - task.goal) + jitter
    solved = np.sqrt(np.sum(off**2, axis=-1)) < GOAL_RADIUS
    names = [can for can in range(CANS) if task.present[can]]

    start = (0,) * len(roads)
    plans: dict[tuple[int, ...], list[int]] = {start: []}
    queue = deque(plans)
    while queue:
        node = queue.popleft()
        if solved[node[TARGET]] and plans[node]:
            return plans[node]
        if len(plans[node]) == HORIZON:
            continue
        for a, road in enumerate(roads):
            for direction, place in enumerate(road.leads[node[a]].tolist()):
                after = (*node[:a], place, *node[a + 1 :])
                if place < 0 or after in plans:
                    continue
                if all(clear[a, b][node[a], direction, node[b]] for b in range(len(roads)) if b != a):
                    plans[after] = [*plans[node], names[a] * len(DIRECTIONS) + direction]
                    queue.append(after)
    return None


def explore(task: Task, can: int) -> Roads:
    """The places that a can reaches, by pushes in batches."""
    places, leads, done = [np.asarray(task.cans[can], float)], [], 0
    while done < len(places):
        now = places[done : done + BATCH]
        padded = np.array(now + [now[-1]] * (BATCH - len(now)))
        outcome = jax.device_get(_push_all(task, jnp.asarray(padded, jnp.float32)))
        for index in range(len(now)):
            row = []
            for direction in range(len(DIRECTIONS)):
                after = outcome.position[index, direction].astype(float)
                stuck = np.array_equal(after, padded[index].astype(np.float32))
                if outcome.fell[index, direction] or outcome.hit[index, direction] or stuck:
                    row.append(-1)
                    continue
                known = np.linalg.norm(np.array(places) - after, axis=-1)
                if known.min() > SAME_PLACE:
                    places.append(after)
                    row.append(len(places) - 1)
                else:
                    row.append(int(known.argmin()))
            leads.append(row)
        done += len(now)
    return Roads(np.array(places), np.array(leads))


def clearances(mover: Roads, other: Roads) -> Bool[np.ndarray, "n 4 m"]:
    """Whether the way of a push, and the place of the tool behind it, are clear of another can at each of its places."""
    start = mover.places[:, None]
    end = mover.places[mover.leads]
    tool = start + TOOL_START * DIRECTIONS[None]
    way = _distance(other.places, start, end) >= 2 * CAN_RADIUS + SPARE
    room = _distance(other.places, tool, tool) >= CAN_RADIUS + TOOL_RADIUS + SPARE
    return way & room


def _distance(
    points: Float[np.ndarray, "m 2"], start: Float[np.ndarray, "n k 2"], end: Float[np.ndarray, "n 4 2"]
) -> Float[np.ndarray, "n 4 m"]:
    """Distances from points to straight ways."""
    along = end - start
    length = np.maximum(np.sum(along**2, axis=-1, keepdims=True), 1e-12)
    share = np.clip(np.einsum("nkmd,nkd->nkm", points[None, None] - start[:, :, None], along) / length, 0, 1)
    nearest = start[:, :, None] + share[..., None] * along[:, :, None]
    return np.linalg.norm(points[None, None] - nearest, axis=-1)


@cache
def _pusher() -> Any:
    def one(task: Task, place: Float[Array, "2"], direction: Int[Array, ""]) -> Outcome:
        cans = jnp.full((CANS, 2), ABSENT).at[0].set(place)
        return push(task, cans, jnp.arange(CANS) == 0, can=jnp.int32(0), direction=direction)

    directions = jnp.arange(len(DIRECTIONS))
    return jax.jit(lambda task, places: jax.vmap(lambda p: jax.vmap(partial(one, task, p))(directions))(places))


def _push_all(task: Task, places: Float[Array, "n 2"]) -> Outcome:
    """A can alone on the table, pushed from every place in every direction; leaves [n, 4, ...]."""
    return _pusher()(task, places)
