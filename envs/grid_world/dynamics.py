"""Moves, keys and doors, rewards and the ends of an episode (paper, appendix "Grid-World")."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int32, Integer

from apt_jax.task_space import StepOutput
from envs.grid_world.board import DOORS, GOAL, KEYS, LAVA, MARGIN, START, WALL, Task
from envs.grid_world.observation import observe

HORIZON = 50
"""Steps after which an episode is cut off."""

MOVES = np.array([(-1, 0), (0, 1), (1, 0), (0, -1)], np.int32)
"""(row, column) of each action: 0 up, 1 right, 2 down, 3 left."""

STEP_COST = 0.001
GOAL_REWARD = 1.0
WALL_PENALTY = 0.001
DEATH_PENALTY = 0.5
START_ON_GOAL_PENALTY = 1.0


class State(NamedTuple):
    """What changes in an episode.

    Attributes:
      position: the agent's (row, column) on the board, always an interior tile.
      keys: whether the yellow and the blue key have been taken; the door of a taken key is gone.
      steps: steps taken so far, in [0, HORIZON].
    """

    position: Int32[Array, "2"]
    keys: Bool[Array, "2"]
    steps: Int32[Array, ""]


def initial_state() -> State:
    """The agent on the start tile, without keys."""
    return State(jnp.array(START, jnp.int32), jnp.zeros(2, bool), jnp.zeros((), jnp.int32))


def visible_objects(keys: Bool[Array | np.ndarray, "2"], task: Task) -> Bool[Array, "5"]:
    """Whether each object is on the board: a taken key is gone, and so is the door of its colour."""
    gone = jnp.concatenate([jnp.zeros(1, bool), keys, keys])
    return task.present & ~gone


def step(state: State, action: Integer[Array, ""], task: Task) -> StepOutput:
    """One move of the agent; `action` must lie in [0, 4).

    The agent enters empty floor, keys and the goal.  It stays where it is when it hits a wall, and also when the episode ends
    on lava or a closed door, so it never stands on either.  Every step costs `STEP_COST`, the last one included, with one
    exception: an agent initialised on the goal gets exactly -1, whatever it does, and does not move.
    """
    ahead = state.position + jnp.asarray(MOVES)[action]
    tile = task.padded[ahead[0] + MARGIN, ahead[1] + MARGIN]
    met = visible_objects(state.keys, task) & jnp.all(task.objects == ahead[None, :], axis=-1)

    # Reaching the goal ends an episode, so an agent about to move off the goal must have started there.
    started_on_goal = task.present[GOAL] & jnp.all(task.objects[GOAL] == state.position)
    success = met[GOAL]
    died = (tile == LAVA) | jnp.any(met[DOORS])
    hit_wall = tile == WALL
    stays = started_on_goal | died | hit_wall

    position = jnp.where(stays, state.position, ahead)
    keys = state.keys | (met[KEYS] & ~stays)
    steps = state.steps + 1
    reward = jnp.select(
        [started_on_goal, success, died, hit_wall],
        [-START_ON_GOAL_PENALTY, GOAL_REWARD - STEP_COST, -DEATH_PENALTY - STEP_COST, -WALL_PENALTY - STEP_COST],
        default=-STEP_COST,
    )
    terminated = started_on_goal | success | died
    return StepOutput(
        state=State(position, keys, steps),
        obs=observe(position, visible_objects(keys, task), task),
        reward=reward.astype(jnp.float32),
        terminated=terminated,
        truncated=(steps >= HORIZON) & ~terminated,
        success=success,
    )
