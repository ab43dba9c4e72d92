"""A task space for exploration: a combination lock, which only a long exact sequence of actions opens."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from apt_jax.specs import Vector
from apt_jax.task_space import StepOutput

LENGTH = 10
ACTIONS = 3
COMBINATION = np.array([0, 2, 1, 1, 0, 2, 0, 1, 2, 1])


class State(NamedTuple):
    """How many actions were right in a row, and the steps made."""

    place: Int[Array, ""]
    steps: Int[Array, ""]


class Lock:
    """One action leads on from each place, every other one back to the start; the last place pays 1 and ends the episode."""

    name = "lock"
    obs_spec: ClassVar = {"place": Vector(LENGTH + 1, 0, 1, "uint8")}
    param_spec: ClassVar = {"unused": Vector(1, 0, 1)}
    num_actions = ACTIONS
    horizon = 2 * LENGTH

    def sample_uniform(self, key):
        return {"unused": jax.random.uniform(key, (1,))}

    def instantiate(self, w):
        return jnp.int32(w["unused"][0])

    def _observe(self, place):
        return {"place": jax.nn.one_hot(place, LENGTH + 1, dtype=jnp.uint8)}

    def reset(self, key, task):
        del key, task
        return State(jnp.int32(0), jnp.int32(0)), self._observe(jnp.int32(0))

    def step(self, state, action, task):
        del task
        right = action.astype(jnp.int32) == jnp.asarray(COMBINATION, jnp.int32)[state.place]
        place, steps = jnp.where(right, state.place + 1, 0), state.steps + 1
        success = place == LENGTH
        truncated = ~success & (steps >= self.horizon)
        return StepOutput(State(place, steps), self._observe(place), success.astype(jnp.float32), success, truncated, success)

    def fingerprint(self, state):
        return state.place[None]

    def describe(self, task, target):
        return {}
