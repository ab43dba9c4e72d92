"""The procedural generation module M(w): from tile scores and object coordinates to a task.

The paper's rule is read as follows (appendix "Grid-World"):

* An object stands on the tile its coordinates lie in, and that tile becomes empty floor.
* It does not appear if that tile is on the border or already holds an earlier object, in the order goal, yellow door, blue
  door, yellow key, blue key.
* On the start tile a goal is legal (the agent starts on the goal), while a door or a key does not appear there.
* A door stays closed if its key does not appear, for whatever reason.
* A key whose door does not appear can be taken and opens nothing.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32, Int32

from apt_jax.specs import Grid, Params, Spec, Vector
from envs.grid_world.board import BOARD, CATEGORIES, GOAL, INTERIOR, OBJECTS, START, Task, make_task

PARAM_SPEC: Spec = {
    "tiles": Grid(INTERIOR, INTERIOR, CATEGORIES),
    "xy": Vector(2 * OBJECTS, low=0, high=BOARD),
}
"""The paper's 74 variables: 64 tile categories, as scores, and 5 pairs (row, column) in tile widths from the upper left."""


def place(w: Params) -> Task:
    """The task of parameter `w` (see `PARAM_SPEC`)."""
    chex.assert_shape(w["tiles"], (INTERIOR, INTERIOR, CATEGORIES))
    chex.assert_shape(w["xy"], (2 * OBJECTS,))
    interior = jnp.argmax(w["tiles"], axis=-1).astype(jnp.uint8)
    objects = chosen_tiles(w["xy"])
    return make_task(interior, objects, appears(objects))


def parameter(task: Task) -> Params:
    """A parameter that `place` makes this task of: one-hot scores, and every object in the middle of its tile.

    Objects that are absent lie on the border.
    """
    tiles = jax.nn.one_hot(task.tiles[1:-1, 1:-1], CATEGORIES)
    return {"tiles": tiles, "xy": task.objects.reshape(-1).astype(jnp.float32) + 0.5}


def chosen_tiles(xy: Float32[Array, "10"]) -> Int32[Array, "5 2"]:
    """The tile (row, column) that each object's coordinates in [0, 10] lie in.

    Tile i spans [i, i + 1) with its centre, the closest one, at i + 0.5: uniform coordinates hit all tiles equally often.
    Exactly 10 belongs to tile 9.
    """
    return jnp.clip(jnp.floor(xy), 0, BOARD - 1).astype(jnp.int32).reshape(OBJECTS, 2)


def appears(objects: Int32[Array, "5 2"]) -> Bool[Array, "5"]:
    """Whether each object appears when it is placed, in order, on its chosen tile."""
    on_border = jnp.any((objects == 0) | (objects == BOARD - 1), axis=-1)
    on_start = jnp.all(objects == jnp.array(START)[None, :], axis=-1)
    same_tile = jnp.all(objects[:, None, :] == objects[None, :, :], axis=-1)
    # An earlier object that was itself refused occupies nothing, yet needs no exception here: what kept it off this tile
    # (border, start, a still earlier object) keeps the later object off it too.
    occupied = jnp.any(jnp.tril(same_tile, k=-1), axis=-1)
    is_goal = jnp.arange(OBJECTS) == GOAL
    return ~(on_border | occupied | (on_start & ~is_goal))
