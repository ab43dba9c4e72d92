"""A hand-made curriculum towards each of Grid-World's targets, the yardstick for those that are learned.

Its tasks are the target with the goal, and perhaps one key, moved to a place on the target's own shortest solution.  Those
that take equally many steps are a rung.  Half of the tasks come from the rung at hand, half from it and all below.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

import envs
from apt_jax.config import Config, HParams
from apt_jax.curricula.base import GENERATED, Curriculum
from apt_jax.plugin import Metrics, no_update
from apt_jax.replay import Replay, Rollouts, latest_episodes
from apt_jax.specs import Params
from apt_jax.task_space import TaskSpace
from envs.grid_world.board import BLUE_KEY, GOAL, START, YELLOW_KEY, Task
from envs.grid_world.dynamics import MOVES
from envs.grid_world.placement import parameter, place
from envs.grid_world.solver import solution_length, solve

PASS_RATE = 0.6
"""Share of a rung's latest tasks that must be solved before the next rung is climbed."""

LEAST_TASKS = 10
"""How many of these there must be."""


class Ladder(NamedTuple):
    """Tasks by the length of their shortest solution.

    Attributes:
      w: parameters of all tasks, leaves [n, ...], short ones first.
      first: where each rung begins in `w`, and where the last one ends.
      steps: length of the shortest solutions of each rung.
    """

    w: Params
    first: Int[np.ndarray, "rungs+1"]
    steps: Float[np.ndarray, "rungs"]


def build(target: Task) -> Ladder:
    """The ladder of a target; its last rung is as long as the target."""
    w = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(parameter(task) for task in variants(target)))
    steps = np.asarray(jax.jit(jax.vmap(lambda w: solution_length(place(w))))(w))
    order = np.argsort(steps, kind="stable")[: np.isfinite(steps).sum()]
    rungs, first = np.unique(steps[order], return_index=True)
    return Ladder(jax.tree.map(lambda x: x[order], w), np.append(first, len(order)), rungs)


def variants(target: Task) -> Iterator[Task]:
    """The target, its goal at each place of its shortest solution, and for each of these either key at an earlier place."""
    path = visited(target)
    for end, goal in enumerate(path):
        nearer = move(target, GOAL, goal)
        yield nearer
        for key in (YELLOW_KEY, BLUE_KEY):
            if target.present[key]:
                yield from (move(nearer, key, place) for place in path[:end] if place not in (START, goal))


def visited(task: Task) -> list[tuple[int, int]]:
    """The places of a shortest solution, each once, in order, without the start."""
    places = np.array(START) + np.cumsum(MOVES[np.array(solve(task))], axis=0)
    return list(dict.fromkeys((int(row), int(column)) for row, column in places))


def move(task: Task, index: int, place: tuple[int, int]) -> Task:
    """The task with one object elsewhere."""
    return task._replace(objects=task.objects.at[index].set(jnp.array(place)))


def make(space: TaskSpace, config: Config, *, target: str) -> Curriculum:
    """Climbs the ladder of the target called `target`, whatever task the run is aimed at."""
    if space.name != "grid_world":
        raise ValueError(f"a ladder is made of boards of grid_world, not for {space.name}")
    ladder = build(envs.load_target(space.name, target))

    def init(key: Key[Array, ""], hparams: HParams) -> Int[Array, ""]:
        del key, hparams
        return jnp.int32(0)

    def propose(state: Int[Array, ""], key: Key[Array, ""], n: int, hparams: HParams) -> Params:
        del hparams
        key_back, key_rung, key_task = jax.random.split(key, 3)
        back = jax.random.bernoulli(key_back, shape=(n,))
        chosen = jnp.where(back, jax.random.randint(key_rung, (n,), 0, state + 1), state)
        first = jnp.asarray(ladder.first)
        task = jax.random.randint(key_task, (n,), first[chosen], first[chosen + 1])
        return jax.tree.map(lambda x: x[task], ladder.w)

    def refresh(
        state: Int[Array, ""], key: Key[Array, ""], replay: Replay, iterations: Int[Array, ""], hparams: HParams
    ) -> Int[Array, ""]:
        del key, iterations, hparams
        episodes, earlier = latest_episodes(replay, source=GENERATED, count=config.return_window)
        steps = jax.vmap(lambda w: solution_length(place(w)))(episodes.w)
        here = (earlier >= 0) & (steps == jnp.asarray(ladder.steps)[state])
        passed = (jnp.sum(here) >= LEAST_TASKS) & (jnp.mean(episodes.success, where=here) >= PASS_RATE)
        return jnp.minimum(state + passed.astype(jnp.int32), len(ladder.steps) - 1)

    def report(state: Int[Array, ""], rollouts: Rollouts, hparams: HParams) -> Metrics:
        del rollouts, hparams
        return {"ladder_steps": jnp.asarray(ladder.steps)[state]}

    return Curriculum(True, init, propose, no_update, refresh, report)
