"""Poses of the tool's tip as the robot sees them; arrays are those of numpy or of JAX, whichever is given.

A pose is x, y and z of the tip in metres, the angle of its normal about the vertical, and its lean: a turn about a horizontal
axis, as the x and y of axis times angle, in radians.
"""

from __future__ import annotations

from typing import Any

from envs.manipulation.push import GAP
from envs.manipulation.sawyer.arm import BASE
from envs.manipulation.scene import TOOL_HALF, TOOL_HEIGHT
from envs.manipulation.table import CAN_RADIUS

Array = Any
"""Of numpy or of JAX."""

LEAN_FROM, LEAN_TO, LEAN = 0.7, 1.0, 0.15
"""Metres from the robot's axis from which on the tool leans outwards and where it leans most, and by how many radians there:
the arm is too short to hold it upright everywhere.  Leaning more, the stick would touch a can's top."""


def behind(place: Array, ahead: Array) -> Array:
    """The pose [6] from which a can at `place` [2] is pushed in the direction `ahead` [2], a unit vector along x or y."""
    xp = place.__array_namespace__()
    heading, leaning = _heading(ahead), lean(place)
    over = xp.stack([place[0], place[1], xp.full_like(heading, TOOL_HEIGHT), heading, leaning[0], leaning[1]])
    gone = CAN_RADIUS + GAP + _extent(over, ahead)
    return xp.concat([place - gone * ahead, over[2:]])


def lean(place: Array) -> Array:
    """Lean [2] of the tool for a push from `place` [2]: away from the robot, the more the farther."""
    xp = place.__array_namespace__()
    x, y = place[0] - BASE[0], place[1] - BASE[1]
    far = xp.sqrt(x * x + y * y)
    angle = LEAN * xp.clip((far - LEAN_FROM) / (LEAN_TO - LEAN_FROM), 0.0, 1.0)
    return xp.stack([angle * y / far, -angle * x / far])


def rotation(pose: Array) -> Array:
    """From the axes of the tip at a pose [6] to the world's, [3, 3]: z down along the stick, x its normal, both leant."""
    xp = pose.__array_namespace__()
    cosine, sine = xp.cos(pose[3]), xp.sin(pose[3])
    upright = xp.array([[cosine, sine, 0.0], [sine, -cosine, 0.0], [0.0, 0.0, -1.0]])
    angle = xp.sqrt(pose[4] ** 2 + pose[5] ** 2)
    x, y = pose[4:] / xp.where(angle == 0, 1.0, angle)
    cross = xp.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    return upright + xp.sin(angle) * (cross @ upright) + (1 - xp.cos(angle)) * (cross @ cross @ upright)


def _heading(ahead: Array) -> Array:
    """The angle of a direction along x or y, from -pi / 2 to pi: so the last joint stays far from its limits."""
    return ahead.__array_namespace__().atan2(ahead[1] + 0.0, ahead[0])  # -0.0 would give -pi


def _extent(pose: Array, ahead: Array) -> Array:
    """How far the tip reaches beyond its centre."""
    xp, turn = pose.__array_namespace__(), rotation(pose)
    along = xp.abs(ahead[0] * turn[0] + ahead[1] * turn[1])
    return along[0] * TOOL_HALF[0] + along[1] * TOOL_HALF[1] + along[2] * TOOL_HALF[2]
