"""A whole task space of one's own, small enough to compile in seconds: walk along a corridor to the goal tile.

    python -m experiments.train --plugins experiments.examples.corridor --space corridor --target far --run-dir runs/corridor

The first half is all that training needs (`apt_jax.task_space.TaskSpace`); targets by name and pictures are for the scripts
(`envs.BenchmarkSpace`); the last line makes the space known to them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt8

import envs
from apt_jax.specs import Grid, Obs, Params, Spec, Vector
from apt_jax.task_space import StepOutput, sample_uniform

LENGTH = 9
OBS_SPEC: Spec = {"position": Vector(1, 0, LENGTH, "uint8"), "offset": Vector(1, -LENGTH, LENGTH, "int8")}
PARAM_SPEC: Spec = {"goal": Vector(1, 0, LENGTH), "paint": Grid(4, 4, 2)}
TARGETS = {"near": "3", "far": "7"}


class State(NamedTuple):
    """Where the agent is, and how many steps it has made."""

    position: Int[Array, ""]
    steps: Int[Array, ""]


class Corridor:
    """The agent starts at tile 0 and moves left or right; the goal tile pays 1 and ends the episode, a step costs 0.01.

    A task is the number of its goal tile, 1 to 8.  `paint` changes nothing: it shows what a grid of categories looks like.
    """

    name: str = "corridor"
    obs_spec: Spec = OBS_SPEC
    param_spec: Spec = PARAM_SPEC
    num_actions: int = 2
    horizon: int = 12

    def sample_uniform(self, key: Key[Array, ""]) -> Params:
        """A task parameter drawn uniformly; consumes `key`."""
        return sample_uniform(self.param_spec, key)

    def instantiate(self, w: Params) -> Int[Array, ""]:
        """The goal's tile."""
        return jnp.clip(jnp.floor(w["goal"][0]).astype(jnp.int32), 1, LENGTH - 1)

    def reset(self, key: Key[Array, ""], task: Int[Array, ""]) -> tuple[State, Obs]:
        """The first tile; `key` is not used, nothing is random."""
        del key
        state = State(jnp.int32(0), jnp.int32(0))
        return state, self._observe(state.position, task)

    def step(self, state: State, action: Int[Array, ""], task: Int[Array, ""]) -> StepOutput:
        """0 moves left, 1 right; the ends of the corridor hold the agent back."""
        position = jnp.clip(state.position + 2 * action.astype(jnp.int32) - 1, 0, LENGTH - 1)
        state = State(position, state.steps + 1)
        success = position == task
        reward = jnp.where(success, 1.0, -0.01)
        truncated = ~success & (state.steps >= self.horizon)
        obs = self._observe(position, task)
        return StepOutput(state, obs, reward, terminated=success, truncated=truncated, success=success)

    def fingerprint(self, state: State) -> Int[Array, "1"]:
        """The tile."""
        return state.position[None]

    def describe(self, task: Int[Array, ""], target: Int[Array, ""]) -> dict[str, Float[Array, ""]]:
        """How long the way is, and how far the goal is from the target's."""
        return {"solution_length": task.astype(jnp.float32), "goal_distance": jnp.abs(task - target).astype(jnp.float32)}

    def _observe(self, position: Int[Array, ""], goal: Int[Array, ""]) -> Obs:
        return {"position": position[None].astype(jnp.uint8), "offset": (goal - position)[None].astype(jnp.int8)}

    targets: Mapping[str, str] = TARGETS
    fps: float = 4.0

    def parse_target(self, text: str) -> Int[np.ndarray, ""]:
        """The goal's tile; raises ValueError if that is none."""
        if text.strip() not in map(str, range(1, LENGTH)):
            raise ValueError(f"expected the goal's tile, 1 to {LENGTH - 1}, got {text.strip()!r}")
        return np.array(int(text), np.int32)

    def render(self, task: Any, state: State | None = None, tile_size: int = 32) -> UInt8[np.ndarray, "height width 3"]:
        """Grey tiles, the goal green, the agent red."""
        tiles = np.full((1, LENGTH, 3), 220, np.uint8)
        tiles[0, int(task)] = 0, 160, 0
        tiles[0, 0 if state is None else int(state.position)] = 220, 0, 0
        return np.kron(tiles, np.ones((tile_size, tile_size, 1), np.uint8))


envs.SPACES["corridor"] = Corridor
