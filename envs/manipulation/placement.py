"""The procedural generation module M(w): from block scores, places, offsets and the goal's range to a task.

* A can on a block that is not flat, or on the block of an earlier can, does not appear (paper, appendix "Manipulation").
* The goal's place is no parameter: it is the same for all tasks of the space.
"""

from __future__ import annotations

import chex
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from apt_jax.specs import Grid, Params, Spec, Table, Vector
from envs.manipulation.table import (
    ABSENT,
    BLOCK,
    CANS,
    CATEGORIES,
    CELLS,
    COLUMNS,
    FLAT,
    PIT,
    ROADBLOCK,
    ROADBLOCK_HEIGHT,
    ROWS,
    Obstacles,
    Task,
)

BLOCKS = COLUMNS * ROWS
OFFSET = 0.02
MIN_RANGE, MAX_RANGE = 0.10, 0.60

GOAL = (0.70, 0.21)
"""(x, y) about which the goal stands in all pictures of the authors."""

PARAM_SPEC: Spec = {
    "blocks": Grid(COLUMNS, ROWS, CATEGORIES),
    "placement": Table(CANS, BLOCKS),
    "offset": Vector(2 * CANS, low=-OFFSET, high=OFFSET),
    "goal_range": Vector(1, low=MIN_RANGE, high=MAX_RANGE),
}
"""The paper's 31 variables: 24 block types and the block of each of 3 cans, as scores, and lengths in metres.

Blocks are indexed by [column, row]; block k of a placement is that of column k // ROWS and row k % ROWS.
"""


def place(w: Params) -> Task:
    """The task of parameter `w` (see `PARAM_SPEC`)."""
    chex.assert_shape(w["blocks"], (COLUMNS, ROWS, CATEGORIES))
    chex.assert_shape(w["placement"], (CANS, BLOCKS))
    blocks = jnp.argmax(w["blocks"], axis=-1)
    chosen = jnp.argmax(w["placement"], axis=-1)
    present = appears(blocks, chosen)
    cans = jnp.asarray(centers())[chosen] + w["offset"].reshape(CANS, 2)
    return Task(
        ground=ground_of(blocks),
        obstacles=roadblocks(blocks),
        cans=jnp.where(present[:, None], cans, ABSENT),
        present=present,
        goal=jnp.array(GOAL, jnp.float32),
        goal_range=w["goal_range"][0],
    )


def appears(blocks: Int[Array, "6 4"], chosen: Int[Array, "3"]) -> Bool[Array, "3"]:
    """Whether each can appears when it is placed, in order, on its chosen block."""
    same_block = chosen[:, None] == chosen[None, :]
    # An earlier can that was itself refused stands on nothing, yet needs no exception here: what kept it off this block keeps
    # the later can off it too.
    occupied = jnp.any(jnp.tril(same_block, k=-1), axis=-1)
    return (blocks.reshape(-1)[chosen] == FLAT) & ~occupied


def ground_of(blocks: Int[Array, "6 4"]) -> Bool[Array, "36 24"]:
    """The surface of a table of blocks; it goes on under roadblocks."""
    return jnp.repeat(jnp.repeat(blocks != PIT, CELLS, axis=0), CELLS, axis=1)


def roadblocks(blocks: Int[Array, "6 4"]) -> Obstacles:
    """A box for every block, there if the block is a roadblock."""
    return Obstacles(
        center=jnp.asarray(centers()),
        half=jnp.full((BLOCKS, 2), BLOCK / 2, jnp.float32),
        axis=jnp.tile(jnp.array([1.0, 0.0]), (BLOCKS, 1)),
        rounding=jnp.zeros(BLOCKS),
        height=jnp.where(blocks.reshape(-1) == ROADBLOCK, jnp.float32(ROADBLOCK_HEIGHT), 0.0),
    )


def centers() -> Float32[np.ndarray, "24 2"]:
    """(x, y) of each block's centre."""
    columns, rows = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
    centers: Float[np.ndarray, "24 2"] = (np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5) * BLOCK
    return centers.astype(np.float32)
