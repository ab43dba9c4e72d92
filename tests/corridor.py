"""A task space small enough to compile in seconds: walk along a corridor to the goal tile."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Int

from apt_jax.specs import Grid, Vector
from apt_jax.task_space import StepOutput, sample_uniform

LENGTH = 9


class State(NamedTuple):
    """Where the agent is and how many steps it made."""

    position: Int[Array, ""]
    steps: Int[Array, ""]


class Corridor:
    """The agent starts at tile 0 and moves left or right; tile `goal` pays 1 and ends the episode; `paint` does nothing."""

    name = "corridor"
    obs_spec: ClassVar = {"position": Vector(1, 0, LENGTH, "uint8"), "offset": Vector(1, -LENGTH, LENGTH, "int8")}
    param_spec: ClassVar = {"goal": Vector(1, 0, LENGTH), "paint": Grid(4, 4, 2)}
    num_actions = 2
    horizon = 12

    def sample_uniform(self, key):
        return sample_uniform(self.param_spec, key)

    def instantiate(self, w):
        return jnp.clip(jnp.floor(w["goal"][0]).astype(jnp.int32), 1, LENGTH - 1)

    def _observe(self, position, goal):
        return {"position": position[None].astype(jnp.uint8), "offset": (goal - position)[None].astype(jnp.int8)}

    def reset(self, key, task):
        del key
        state = State(jnp.int32(0), jnp.int32(0))
        return state, self._observe(state.position, task)

    def step(self, state, action, task):
        position = jnp.clip(state.position + 2 * action.astype(jnp.int32) - 1, 0, LENGTH - 1)
        steps = state.steps + 1
        success = position == task
        reward = jnp.where(success, 1.0, -0.01)
        truncated = ~success & (steps >= self.horizon)
        return StepOutput(State(position, steps), self._observe(position, task), reward, success, truncated, success)

    def fingerprint(self, state):
        return state.position[None]

    def describe(self, task, target):
        return {"distance": task.astype(jnp.float32), "goal_distance": jnp.abs(task - target).astype(jnp.float32)}
