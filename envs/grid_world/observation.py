"""What the agent sees, stored compactly; networks scale it (paper, appendix "Grid-World", state space)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int32

from apt_jax.specs import Grid, Obs, Spec, Vector
from envs.grid_world.board import BOARD, CATEGORIES, OBJECTS, VIEW, Task

OBS_SPEC: Spec = {
    "agent": Vector(2, low=0, high=BOARD - 1, dtype="uint8"),
    "view": Grid(VIEW, VIEW, CATEGORIES),
    "objects": Vector(2 * OBJECTS, low=1 - BOARD, high=BOARD - 1, dtype="int8"),
}


def observe(position: Int32[Array, "2"], visible: Bool[Array, "5"], task: Task) -> Obs:
    """The observation of an agent at the interior tile `position` while the `visible` objects are on the board.

    `agent`: (row, column) on the board.  `view`: tile categories centred on the agent, walls outside the board.  `objects`:
    (row, column) of each object minus the agent's, in tiles; (0, 0) for an object that is not visible.
    """
    # The first stored row is MARGIN above the board, hence VIEW // 2 above interior row 1.
    corner = position - 1
    relative = jnp.where(visible[:, None], task.objects - position[None, :], 0)
    return {
        "agent": position.astype(jnp.uint8),
        "view": jax.lax.dynamic_slice(task.padded, (corner[0], corner[1]), (VIEW, VIEW)),
        "objects": relative.astype(jnp.int8).reshape(2 * OBJECTS),
    }
