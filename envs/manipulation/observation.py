"""What the agent sees (paper, appendix "Manipulation", state space)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from apt_jax.specs import Obs, Spec, Vector
from envs.manipulation.table import CANS, DIRECTIONS, PIT_DEPTH, ROADBLOCK_HEIGHT, Task, landscape

REACH = 0.10
"""Metres from a can to the points whose height the agent sees: about one push."""

OBS_SPEC: Spec = {
    "positions": Vector(2 * (CANS + 1), low=-1.0, high=1.0),
    "landscape": Vector(CANS * len(DIRECTIONS), low=-PIT_DEPTH, high=ROADBLOCK_HEIGHT),
}


def observe(cans: Float[Array, "3 2"], goal: Float[Array, "2"], task: Task) -> Obs:
    """The observation of cans at some places and a goal's centre.

    `positions`: (x, y) of each can, `ABSENT` if it does not appear, then of the goal, in metres.  `landscape`: for each can the
    heights in metres at `REACH` from it in each direction, at most that of a roadblock; 0 for a can that does not appear.
    """
    around = cans[:, None] + REACH * jnp.asarray(DIRECTIONS)[None]
    heights = landscape(task, around.reshape(-1, 2)).reshape(CANS, -1)
    seen = jnp.where(task.present[:, None], jnp.minimum(heights, ROADBLOCK_HEIGHT), 0.0)
    return {"positions": jnp.concatenate([cans.reshape(-1), goal]), "landscape": seen.reshape(-1)}
