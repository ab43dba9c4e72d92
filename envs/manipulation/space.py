"""The Manipulation task space of the paper, behind the `TaskSpace` protocol."""

from __future__ import annotations

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer, Key, UInt8

from apt_jax.specs import Obs, Params, Spec
from apt_jax.task_space import StepOutput, sample_uniform
from envs.manipulation import arms, dynamics, scene
from envs.manipulation.dynamics import HORIZON, State
from envs.manipulation.layout import parse_table
from envs.manipulation.observation import OBS_SPEC, observe
from envs.manipulation.placement import PARAM_SPEC, centers, place
from envs.manipulation.render import render
from envs.manipulation.table import CANS, DIRECTIONS, TARGET, Task, landscape
from envs.manipulation.targets import TARGETS


class Space:
    """A table of blocks with holes and roadblocks on which a can is to be pushed to the goal, past other cans.

    Attributes:
      targets: text of each target task by name, for `parse_target`.
      fps: pushes per second at which a film of an episode is watched, without the robot.
      goal_jitter: metres along x and y within which an episode's goal is drawn about the task's, in all tasks alike.
      arm: what pushes the cans, a name of `arms.ARMS`.

    Raises:
      ValueError: a wrong name of an arm, a `goal_jitter` that is negative or not finite, or `MUJOCO_GL` names a library that is
        missing.
    """

    name: str = "manipulation"
    obs_spec: Spec = OBS_SPEC
    param_spec: Spec = PARAM_SPEC
    num_actions: int = CANS * len(DIRECTIONS)
    horizon: int = HORIZON
    targets: Mapping[str, str] = TARGETS
    fps: float = 2.0

    def __init__(self, goal_jitter: float = 0.03, arm: str = "tool"):
        scene.check_drawing()
        if not 0.0 <= goal_jitter < math.inf:
            raise ValueError(f"goal_jitter must be finite and at least 0, got {goal_jitter}")
        self.goal_jitter, self.arm = goal_jitter, arm
        self.name = Space.name if arm == "tool" else f"{Space.name}_{arm}"
        self._arm = arms.arm(arm)

    def sample_uniform(self, key: Key[Array, ""]) -> Params:
        """Scores in [0, 1), lengths in their range in metres, both uniform (`task_space.sample_uniform`); consumes `key`."""
        return sample_uniform(self.param_spec, key)

    def instantiate(self, w: Params) -> Task:
        """The task of parameter `w`; see `placement` for the rules."""
        return place(w)

    def reset(self, key: Key[Array, ""], task: Task) -> tuple[State, Obs]:
        """The cans as the task has them and a goal near the task's; consumes `key`."""
        goal = task.goal + jax.random.uniform(key, (2,), minval=-self.goal_jitter, maxval=self.goal_jitter)
        return State(task.cans, goal, jnp.int32(0)), observe(task.cans, goal, task)

    def step(self, state: State, action: Integer[Array, ""], task: Task) -> StepOutput:
        """One push: can `action // 4` in direction `action % 4` (see `DIRECTIONS`); see `dynamics` for the rules."""
        return dynamics.step(state, action, task, self._arm)

    def fingerprint(self, state: State) -> Int[Array, "6"]:
        """Where the cans are, in centimetres; of an absent one too, which never moves."""
        return jnp.round(100.0 * state.cans).astype(jnp.int32).reshape(-1)

    def describe(self, task: Task, target: Task) -> dict[str, Float[Array, ""]]:
        """What a task is built of and how far it is from the target; whether it can be solved would take thousands of pushes.

        `cans`: how many appear.  `target_can`: 1 if the one to be pushed does, else 0.  `pits`, `roadblocks`: shares of the
        blocks, in [0, 1], by the height of their centres.  `goal_range`: r2 in metres.  `goal_way`: metres from the can to be
        pushed to the goal, NaN if it is absent.  `block_distance`: share of the blocks whose height is not the target's.
        `can_distance`: mean metres between a can's places in both, over cans that are in both; NaN if none is.
        """
        heights, wanted = (landscape(table, jnp.asarray(centers())) for table in (task, target))
        both = task.present & target.present
        apart = jnp.sqrt(jnp.sum((task.cans - target.cans) ** 2, axis=-1))
        way = jnp.sqrt(jnp.sum((task.cans[TARGET] - task.goal) ** 2))
        return {
            "cans": jnp.sum(task.present).astype(jnp.float32),
            "target_can": task.present[TARGET].astype(jnp.float32),
            "pits": jnp.mean(heights < 0),
            "roadblocks": jnp.mean(heights > 0),
            "goal_range": task.goal_range,
            "goal_way": jnp.where(task.present[TARGET], way, jnp.nan),
            "block_distance": jnp.mean(heights != wanted),
            "can_distance": jnp.mean(apart, where=both),
        }

    def parse_target(self, text: str) -> Task:
        """The task of a text; raises ValueError with the line and column of a mistake (see `layout`)."""
        return parse_table(text)

    def render(self, task: Task, state: State | None = None, tile_size: int = 32) -> UInt8[np.ndarray, "height width 3"]:
        """RGB picture of a task from above, in `state` or as it starts, with `tile_size` pixels per block."""
        return render(task, state, tile_size=tile_size)
