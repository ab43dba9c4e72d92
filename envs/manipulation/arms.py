"""What can push the cans, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from apt_jax.registry import look_up
from envs.manipulation.push import Arm, tool


def _sawyer() -> Arm:
    from envs.manipulation.sawyer.simulation import sawyer  # imports MuJoCo, which takes a second

    return sawyer


ARMS: Mapping[str, Callable[[], Arm]] = {"tool": lambda: tool, "sawyer": _sawyer}
"""`tool`: a tool that slides by itself.  `sawyer`: one held by a Sawyer arm, whose seven joints are simulated."""


def arm(name: str) -> Arm:
    """The arm called `name`; raises ValueError on a wrong name."""
    return look_up(ARMS, name, "arm")()
