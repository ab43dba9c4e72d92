"""The table: its sizes, what stands on it, and the task they make up.

Lengths are in metres.  x runs along the table's 90 cm from the left, y along its 60 cm away from the robot, both as seen by
someone who faces the robot; z is the height above the table's surface.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

COLUMNS, ROWS = 6, 4
BLOCK = 0.15
"""Blocks along x and y, and their side (paper, appendix "Manipulation")."""

SIZE = (COLUMNS * BLOCK, ROWS * BLOCK)
"""Extent of the table along x and y."""

CATEGORIES = 3
FLAT, PIT, ROADBLOCK = range(CATEGORIES)

CELLS = 6
"""Cells of the surface along a block's side: a table can have holes and edges finer than blocks."""

CELL = BLOCK / CELLS

OBSTACLES = COLUMNS * ROWS
"""Obstacles of a table at most: every block may be a roadblock."""

CANS = 3
TARGET = 0
"""Cans, and which of them is to reach the goal."""

CAN_RADIUS, CAN_HEIGHT = 0.0425, 0.10

PIT_DEPTH, ROADBLOCK_HEIGHT = 0.05, 0.10
"""How deep a pit is and how high a roadblock; around the table it is as deep as in a pit."""

DIRECTIONS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], np.float32)
"""(x, y) of each direction: 0 right, 1 away from the robot, 2 left, 3 towards the robot."""

ABSENT = -1.0
"""Both coordinates of a can that does not appear (paper, state space)."""

FAR = 10.0
"""Metres to an obstacle or can that is not there."""


class Obstacles(NamedTuple):
    """Static obstacles with vertical walls, each over all points within `rounding` of a rectangle.

    A rectangle without rounding is a box, a rectangle without extent a cylinder.

    Attributes:
      center: (x, y) of the rectangle.
      half: half its extents, along `axis` and across.
      axis: unit vector of its first side.
      rounding: radius of its corners, at least 0, added to its extents.
      height: above the surface; 0 for an obstacle that is not there.
    """

    center: Float32[Array, "24 2"]
    half: Float32[Array, "24 2"]
    axis: Float32[Array, "24 2"]
    rounding: Float32[Array, "24"]
    height: Float32[Array, "24"]


class Task(NamedTuple):
    """One concrete table, with what stands on it as an episode starts.

    Attributes:
      ground: whether a cell of the surface is there, by [cell along x, cell along y]; else it is a hole.
      obstacles: what cans must not meet, beside each other.
      cans: (x, y) of each can's axis; `ABSENT` if it does not appear.
      present: whether each can appears.
      goal: (x, y) about which the goal's centre is drawn.
      goal_range: r2, distance of the target can from the goal's centre within which progress pays.
    """

    ground: Bool[Array, "36 24"]
    obstacles: Obstacles
    cans: Float32[Array, "3 2"]
    present: Bool[Array, "3"]
    goal: Float32[Array, "2"]
    goal_range: Float32[Array, ""]


def on_ground(ground: Bool[Array, "36 24"], points: Float[Array, "n 2"]) -> Bool[Array, "n"]:
    """Whether the surface is there under each point; it is not beyond the table."""
    cells = jnp.floor(points / CELL).astype(jnp.int32)
    nearest = jnp.clip(cells, 0, jnp.array(ground.shape)[None] - 1)
    return jnp.all(cells == nearest, axis=-1) & jnp.asarray(ground)[nearest[:, 0], nearest[:, 1]]


def distances(obstacles: Obstacles, point: Float[Array, "2"]) -> Float[Array, "24"]:
    """Signed distance from a point to each obstacle's footprint, negative inside; `FAR` for those not there."""
    offset = point[None] - obstacles.center
    along = jnp.sum(offset * obstacles.axis, axis=-1)
    across = offset[:, 1] * obstacles.axis[:, 0] - offset[:, 0] * obstacles.axis[:, 1]
    beyond = jnp.abs(jnp.stack([along, across], axis=-1)) - obstacles.half
    outside = jnp.sqrt(jnp.sum(jnp.maximum(beyond, 0.0) ** 2, axis=-1))
    inside = jnp.minimum(jnp.max(beyond, axis=-1), 0.0)
    return jnp.where(obstacles.height > 0, outside + inside - obstacles.rounding, FAR)


def landscape(task: Task, points: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Height at each point: of the highest obstacle there, else 0 on the surface and `-PIT_DEPTH` where it is missing."""
    over = jax.vmap(distances, in_axes=(None, 0))(task.obstacles, points) <= 0
    top = jnp.max(jnp.where(over, task.obstacles.height[None], 0.0), axis=-1)
    return jnp.where(top > 0, top, jnp.where(on_ground(task.ground, points), 0.0, -PIT_DEPTH))
