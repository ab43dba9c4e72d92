"""CartPole of gymnax as a task space with a single task."""

from __future__ import annotations

from typing import Any

import gymnax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from apt_jax.specs import Obs, Params, Spec, Vector
from apt_jax.task_space import StepOutput

TASK = np.int32(0)


class CartPole:
    """Every step pays 1 until the pole falls, the cart leaves the track, or 500 steps are over."""

    name: str = "cart_pole"
    obs_spec: Spec = {"state": Vector(4, -1.0, 1.0)}  # bounds of 1: networks see the numbers as they are  # noqa: RUF012
    param_spec: Spec = {"nothing": Vector(1, 0.0, 1.0)}  # noqa: RUF012
    num_actions: int = 2

    def __init__(self) -> None:
        self.env, self.params = gymnax.make("CartPole-v1")
        self.horizon: int = self.params.max_steps_in_episode

    def sample_uniform(self, key: Key[Array, ""]) -> Params:
        """A parameter that means nothing."""
        del key
        return {"nothing": jnp.zeros(1)}

    def instantiate(self, w: Params) -> Int[Array, ""]:
        """The only task."""
        del w
        return jnp.asarray(TASK)

    def reset(self, key: Key[Array, ""], task: Int[Array, ""]) -> tuple[Any, Obs]:
        """Cart and pole nearly at rest; consumes `key`."""
        del task
        obs, state = self.env.reset_env(key, self.params)
        return state, {"state": obs}

    def step(self, state: Any, action: Int[Array, ""], task: Int[Array, ""]) -> StepOutput:
        """A push to the left (0) or right (1)."""
        del task
        obs, state, reward, done, _ = self.env.step_env(None, state, action, self.params)
        truncated = state.time >= self.horizon
        return StepOutput(state, {"state": obs}, reward, done & ~truncated, truncated, jnp.array(False))

    def fingerprint(self, state: Any) -> Int[Array, "1"]:
        """The step's number."""
        return jnp.atleast_1d(state.time)

    def describe(self, task: Int[Array, ""], target: Int[Array, ""]) -> dict[str, Float[Array, ""]]:
        """Nothing."""
        del task, target
        return {}
