"""The board: its sizes, tile categories and objects, and the task they make up."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int32, UInt8

INTERIOR = 8
"""Rows and columns that a task configures (paper, appendix "Grid-World")."""

BOARD = INTERIOR + 2
"""Rows and columns with the border walls; positions are (row, column) on this board, each in [0, BOARD)."""

START = (1, 1)
"""Where the agent starts: the interior's upper-left tile, always empty floor."""

VIEW = 7
"""Rows and columns of the view centred on the agent."""

CATEGORIES = 3
EMPTY, WALL, LAVA = range(CATEGORIES)

OBJECTS = 5
GOAL, YELLOW_DOOR, BLUE_DOOR, YELLOW_KEY, BLUE_KEY = range(OBJECTS)
DOORS = slice(YELLOW_DOOR, BLUE_DOOR + 1)
KEYS = slice(YELLOW_KEY, BLUE_KEY + 1)

MARGIN = VIEW // 2 - 1
"""Walls stored beyond the border, so that a view from any interior tile is a plain slice."""


class Task(NamedTuple):
    """One concrete grid world.

    Attributes:
      padded: tile categories of the board inside `MARGIN` further walls; the tile under an object is empty floor.
      objects: (row, column) of goal, yellow door, blue door, yellow key, blue key; (0, 0) if absent.
      present: whether each object appears in the task.
    """

    padded: UInt8[Array, "14 14"]
    objects: Int32[Array, "5 2"]
    present: Bool[Array, "5"]

    @property
    def tiles(self) -> UInt8[Array | np.ndarray, "*batch 10 10"]:
        """Tile categories of the board, border included; of every board if tasks are stacked."""
        return self.padded[..., MARGIN:-MARGIN, MARGIN:-MARGIN]


def make_task(interior: UInt8[Array, "8 8"], objects: Int32[Array, "5 2"], present: Bool[Array, "5"]) -> Task:
    """The task with these interior tile categories and objects.

    The start tile and the tiles of present objects become empty floor, so that doors cut through walls.
    """
    cleared = jnp.any(footprints(objects, present), axis=0).at[START].set(True)
    floor = jnp.where(cleared[1:-1, 1:-1], EMPTY, interior).astype(jnp.uint8)
    return Task(
        padded=jnp.pad(floor, MARGIN + 1, constant_values=WALL),
        objects=jnp.where(present[:, None], objects, 0),
        present=present,
    )


def footprints(objects: Int32[Array, "5 2"], shown: Bool[Array, "5"]) -> Bool[Array, "5 10 10"]:
    """For every object the board tile it stands on; no tile for an object that is not `shown`."""
    index = jnp.arange(BOARD)[None, :]
    rows = objects[:, 0, None] == index
    columns = objects[:, 1, None] == index
    return shown[:, None, None] & rows[:, :, None] & columns[:, None, :]
