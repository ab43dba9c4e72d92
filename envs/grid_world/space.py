"""The Grid-World task space of the paper, behind the `TaskSpace` protocol."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer, Key, UInt8

from apt_jax.specs import Obs, Params, Spec
from apt_jax.task_space import StepOutput, sample_uniform
from envs.grid_world import dynamics
from envs.grid_world.board import GOAL, LAVA, WALL, Task
from envs.grid_world.dynamics import HORIZON, MOVES, State
from envs.grid_world.layout import parse_layout
from envs.grid_world.observation import OBS_SPEC, observe
from envs.grid_world.placement import PARAM_SPEC, place
from envs.grid_world.render import render
from envs.grid_world.solver import solution_length
from envs.grid_world.targets import TARGETS


class Space:
    """Mazes with lava, two coloured doors and their keys; an agent in one corner is to reach the goal.

    Attributes:
      targets: layout of each target task by name, for `parse_target`.
      fps: steps per second at which a film of an episode is watched.
    """

    name: str = "grid_world"
    obs_spec: Spec = OBS_SPEC
    param_spec: Spec = PARAM_SPEC
    num_actions: int = len(MOVES)
    horizon: int = HORIZON
    targets: Mapping[str, str] = TARGETS
    fps: float = 5.0

    def sample_uniform(self, key: Key[Array, ""]) -> Params:
        """Scores in [0, 1), coordinates in [0, 10) tiles, both uniform (`task_space.sample_uniform`); consumes `key`."""
        return sample_uniform(self.param_spec, key)

    def instantiate(self, w: Params) -> Task:
        """The task of parameter `w`; see `placement` for the rules."""
        return place(w)

    def reset(self, key: Key[Array, ""], task: Task) -> tuple[State, Obs]:
        """The one initial state of a task and its observation; `key` is not used."""
        del key
        state = dynamics.initial_state()
        return state, observe(state.position, dynamics.visible_objects(state.keys, task), task)

    def step(self, state: State, action: Integer[Array, ""], task: Task) -> StepOutput:
        """One move (0 up, 1 right, 2 down, 3 left); see `dynamics` for the rules."""
        return dynamics.step(state, action, task)

    def fingerprint(self, state: State) -> Int[Array, "4"]:
        """The agent's row and column, and which of the two keys are held."""
        return jnp.concatenate([state.position, state.keys.astype(jnp.int32)])

    def describe(self, task: Task, target: Task) -> dict[str, Float[Array, ""]]:
        """How a task can be solved, what it is built of, and how far it is from the target.

        `feasible`: 1 if it can be solved within the horizon, else 0.  `solution_length`: steps of the shortest solution, NaN if
        infeasible.  `walls`, `lava`: shares of the 64 interior tiles, in [0, 1].  `tile_distance`: share of the interior tiles
        whose category is not the target's.  `goal_distance`: rows plus columns between both goals, NaN if either is absent.
        """
        length = solution_length(task)
        interior, wanted = (board.tiles[1:-1, 1:-1] for board in (task, target))
        apart = jnp.sum(jnp.abs(task.objects[GOAL] - target.objects[GOAL]))
        return {
            "feasible": (~jnp.isnan(length)).astype(jnp.float32),
            "solution_length": length,
            "walls": jnp.mean(interior == WALL),
            "lava": jnp.mean(interior == LAVA),
            "tile_distance": jnp.mean(interior != wanted),
            "goal_distance": jnp.where(task.present[GOAL] & target.present[GOAL], apart.astype(jnp.float32), jnp.nan),
        }

    def parse_target(self, text: str) -> Task:
        """The task of a text layout; raises ValueError with the line and column of a mistake (see `layout`)."""
        return parse_layout(text)

    def render(self, task: Task, state: State | None = None, tile_size: int = 32) -> UInt8[np.ndarray, "height width 3"]:
        """RGB picture of a task, in `state` or as it starts, with `tile_size` pixels per tile."""
        return render(task, state, tile_size=tile_size)
