"""Task spaces in pure JAX, by name, with their target tasks.

A new space is a package with a class that fulfils `BenchmarkSpace`, and one entry in `SPACES`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from apt_jax.registry import look_up
from apt_jax.task_space import TaskSpace
from envs import grid_world, manipulation


@runtime_checkable
class BenchmarkSpace(TaskSpace, Protocol):
    """A task space that comes with target tasks and pictures.

    Attributes:
      targets: text of each target task by name, for `parse_target`.
      fps: steps per second at which a film of an episode is watched.
    """

    targets: Mapping[str, str]
    fps: float

    def parse_target(self, text: str) -> Any:
        """The task that `text` describes; raises ValueError saying where the text is wrong."""
        ...

    def render(self, task: Any, state: Any = None, tile_size: int = 32) -> UInt8[np.ndarray, "height width 3"]:
        """RGB picture of a task in `state`, or as it starts; runs on the host."""
        ...


SPACES: dict[str, Callable[[], BenchmarkSpace]] = {
    "grid_world": grid_world.Space,
    "manipulation": manipulation.Space,
    "manipulation_sawyer": partial(manipulation.Space, arm="sawyer"),
}
"""Constructor of each task space by name."""


def make(name: str) -> BenchmarkSpace:
    """The task space called `name`; raises ValueError on a wrong name."""
    return look_up(SPACES, name, "task space")()


def load_target(space_name: str, target: str) -> Any:
    """The target task called `target` (such as "A") of a space; raises ValueError on a wrong name."""
    space = make(space_name)
    return space.parse_target(look_up(space.targets, target, f"target of {space_name}"))


def load_target_file(space_name: str, path: str | Path) -> Any:
    """The target task described in a user's text file.

    Raises:
      ValueError: on a wrong name, or with the file's name and the place of a mistake in it.
      OSError: if the file cannot be read.
    """
    space = make(space_name)
    try:
        return space.parse_target(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
