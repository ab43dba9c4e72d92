"""Pushes, rewards and the ends of an episode (paper, appendix "Manipulation")."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Float32, Int32, Integer

from apt_jax.task_space import StepOutput
from envs.manipulation.observation import observe
from envs.manipulation.push import STROKE, Arm, push, tool
from envs.manipulation.table import DIRECTIONS, TARGET, Task

HORIZON = 15
"""Pushes after which an episode is cut off."""

GOAL_RADIUS = 0.10
"""r1: the target's centre this close to the goal's, in metres, is success."""

GOAL_REWARD = 1.0
FALL_PENALTY = 0.2
HIT_PENALTY = 0.1


class State(NamedTuple):
    """What changes in an episode.

    Attributes:
      cans: (x, y) of each can; `ABSENT` if it does not appear.
      goal: (x, y) of the goal's centre, the same throughout the episode.
      steps: pushes so far, in [0, HORIZON].
    """

    cans: Float32[Array, "3 2"]
    goal: Float32[Array, "2"]
    steps: Int32[Array, ""]


def step(state: State, action: Integer[Array, ""], task: Task, arm: Arm = tool) -> StepOutput:
    """One push by an arm; `action` in [0, 12) is the can times four plus the direction.

    The target in the goal when a push is over is success, whichever can was pushed.  A push during which a can falls or meets
    something ends the episode and pays the penalty alone.
    """
    can, direction = action // len(DIRECTIONS), action % len(DIRECTIONS)
    outcome = push(task, state.cans, task.present, can=can, direction=direction, arm=arm)
    cans = state.cans.at[can].set(outcome.position)
    before, after = (jnp.sqrt(jnp.sum((places[TARGET] - state.goal) ** 2)) for places in (state.cans, cans))

    calm = task.present[TARGET] & ~outcome.fell & ~outcome.hit
    success = calm & (after < GOAL_RADIUS)
    made = progress(after, task.goal_range) - progress(before, task.goal_range)
    reward = (
        jnp.where(success, GOAL_REWARD, 0.0)
        + jnp.where(calm, made, 0.0)
        - jnp.where(outcome.fell, FALL_PENALTY, 0.0)
        - jnp.where(outcome.hit, HIT_PENALTY, 0.0)
    )
    steps = state.steps + 1
    terminated = success | outcome.fell | outcome.hit
    return StepOutput(
        state=State(cans, state.goal, steps),
        obs=observe(cans, state.goal, task),
        reward=reward,
        terminated=terminated,
        truncated=(steps >= HORIZON) & ~terminated,
        success=success,
    )


def progress(distance: Float[Array, ""], goal_range: Float[Array, ""]) -> Float[Array, ""]:
    """What the way from r2 (`goal_range`) to `distance` from the goal has paid; a push pays what this changes by.

    The paper pays d / (r2 - r1) for a move of d towards the goal inside r2: 1 for the whole way from r2 to r1.  Taken literally
    that is infinite for the targets, whose r2 equals r1.  So no metre pays more than 1 / `STROKE`, and the whole way pays
    1 from r2 = r1 + `STROKE` on, less below, nothing at r2 = r1.  A move away costs what the same move towards the goal pays.
    """
    way = goal_range - GOAL_RADIUS
    return jnp.clip(goal_range - distance, 0.0, jnp.maximum(way, 0.0)) / jnp.maximum(way, STROKE)
