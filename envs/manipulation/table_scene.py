"""A table in full, for MuJoCo: every block, obstacle and can in its true shape, and the tool of one push."""

from __future__ import annotations

import math
from collections.abc import Iterator

import jax
import numpy as np
from jaxtyping import Bool, Float

from envs.manipulation.scene import FRICTION, GRAVITY, can_inertia, tool
from envs.manipulation.table import CAN_HEIGHT, CAN_RADIUS, CELL, PIT_DEPTH, Task

TIMESTEP = 0.001

TOOL_FRICTION = 0.2
"""Sliding friction of a can on the tool; on the surface it is the larger one of `scene`."""


def table_xml(task: Task, cans: Float[np.ndarray, "3 2"], tool_pose: tuple[float, float, float] | None = None) -> str:
    """MJCF of a task with cans at some places, as free bodies `can0` to `can2`, those absent left out.

    Obstacles are `obstacle*`, the surface is `ground*`.  Friction cones are elliptic: with pyramids, which are MuJoCo's
    default, sliding cans hop by a millimetre.

    Args:
      tool_pose: (x, y) of the tool's centre and the angle of its motion, in radians; without it there is no tool.
    """
    task = jax.device_get(task)
    bodies = [_can(i, *place) for i, (place, present) in enumerate(zip(cans, task.present, strict=True)) if present]
    return f"""
<mujoco model="table">
  <compiler angle="radian"/>
  <option timestep="{TIMESTEP}" gravity="0 0 {-GRAVITY}" cone="elliptic"/>
  <default><geom solref="0.01 1" friction="{FRICTION} .005 .0001"/></default>
  <worldbody>
    {"".join(_ground(np.asarray(task.ground)))}
    {"".join(_obstacles(task))}
    {"".join(bodies)}
    {_tool(*tool_pose) if tool_pose else ""}
  </worldbody>
</mujoco>"""


def _can(index: int, x: float, y: float) -> str:
    name, size = f"can{index}", f"{CAN_RADIUS} {CAN_HEIGHT / 2}"
    return f"""
    <body name="{name}" pos="{x} {y} {CAN_HEIGHT / 2}">
      <freejoint name="{name}"/>
      {can_inertia(0.0)}
      <geom name="{name}" type="cylinder" size="{size}" friction="{TOOL_FRICTION} .005 .0001" conaffinity="3"/>
    </body>"""


def _tool(x: float, y: float, angle: float) -> str:
    """A frame turned by `angle` puts the tool's +x along its motion; it meets nothing but cans."""
    body = tool(contype="2", conaffinity="0", friction=f"{TOOL_FRICTION} .005 .0001")
    return f'<frame pos="{x} {y} 0" euler="0 0 {angle}">{body}</frame>'


def _ground(ground: Bool[np.ndarray, "36 24"]) -> Iterator[str]:
    """Boxes under the surface, as few as cover each cell once: equal runs of cells side by side are one box."""
    width = len(ground)
    open_runs: dict[tuple[int, int], int] = {}
    for column in range(width + 1):
        runs = set(_runs(ground[column])) if column < width else set()
        for run in [run for run in open_runs if run not in runs]:
            yield _slab(open_runs.pop(run), column, *run)
        for run in runs:
            open_runs.setdefault(run, column)


def _runs(cells: Bool[np.ndarray, "n"]) -> Iterator[tuple[int, int]]:
    """First and one past the last index of each run of true cells."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], cells.astype(int), [0]])))
    yield from ((int(first), int(last)) for first, last in edges.reshape(-1, 2))


def _slab(left: int, right: int, near: int, far: int) -> str:
    center = f"{(left + right) / 2 * CELL} {(near + far) / 2 * CELL} {-PIT_DEPTH / 2}"
    half = f"{(right - left) / 2 * CELL} {(far - near) / 2 * CELL} {PIT_DEPTH / 2}"
    return f'<geom name="ground{left}_{near}" type="box" pos="{center}" size="{half}"/>'


def _obstacles(task: Task) -> Iterator[str]:
    """Boxes and cylinders; a rounded rectangle is two boxes and a cylinder at each corner."""
    for index, (center, half, axis, rounding, height) in enumerate(zip(*task.obstacles, strict=True)):
        if height <= 0:
            continue
        frame = f'<frame pos="{center[0]} {center[1]} 0" euler="0 0 {math.atan2(axis[1], axis[0])}">'
        length, width = half
        boxes = {(length + rounding, width), (length, width + rounding)}
        corners = {(sx * length, sy * width) for sx in (-1, 1) for sy in (-1, 1)} if rounding > 0 else set()
        shapes = [("box", f"{a} {b} {height / 2}", (0.0, 0.0)) for a, b in boxes if min(a, b) > 0]
        shapes += [("cylinder", f"{rounding} {height / 2}", corner) for corner in corners]
        geoms = [
            f'<geom name="obstacle{index}_{part}" type="{kind}" size="{size}" pos="{place[0]} {place[1]} {height / 2}"/>'
            for part, (kind, size, place) in enumerate(shapes)
        ]
        yield f"{frame}{''.join(geoms)}</frame>"
