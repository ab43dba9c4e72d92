"""Small maps to test Grid-World with."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import envs

UP, RIGHT, DOWN, LEFT = range(4)
EMPTY, WALL, LAVA = range(3)
GOAL, YELLOW_DOOR, BLUE_DOOR, YELLOW_KEY, BLUE_KEY = range(5)

SPACE = envs.make("grid_world")
STEP = jax.jit(SPACE.step)
PLACE = jax.jit(SPACE.instantiate)


def layout(*top: str) -> str:
    """A layout whose first rows are `top`, padded with floor; G stands in the far corner unless `top` has one."""
    rows = [row.ljust(8, ".") for row in top] + ["........"] * (8 - len(top))
    if "G" not in "".join(rows):
        rows[-1] = rows[-1][:-1] + "G"
    return "\n".join(rows)


def play(task, actions):
    """The step outputs of `actions` from the start of an episode; nothing may follow the end of it."""
    state, _ = SPACE.reset(jax.random.key(0), task)
    outs = []
    for action in actions:
        assert not (outs and (outs[-1].terminated or outs[-1].truncated)), "the episode is over"
        outs.append(STEP(state, jnp.int32(action), task))
        state = outs[-1].state
    return outs


def assert_step(out, *, position, reward, terminated=False, truncated=False, success=False):
    assert out.state.position.tolist() == list(position)
    assert out.reward == np.float32(reward)
    assert (bool(out.terminated), bool(out.truncated), bool(out.success)) == (terminated, truncated, success)


def params(objects=(), tiles=()) -> dict[str, jax.Array]:
    """A parameter with categories `tiles` {(row, column): category} on floor, and `objects` {index: (row, column)}.

    Positions are on the 10 x 10 board; objects that are not named lie on the border.
    """
    scores = np.zeros((8, 8, 3), np.float32)
    scores[..., EMPTY] = 1
    for (row, column), category in dict(tiles).items():
        scores[row - 1, column - 1] = np.eye(3)[category]
    xy = np.zeros((5, 2), np.float32)
    for index, place in dict(objects).items():
        xy[index] = np.array(place) + 0.5
    return {"tiles": jnp.asarray(scores), "xy": jnp.asarray(xy.reshape(10))}


def load_all():
    """The paper's targets by name."""
    return {name: envs.load_target("grid_world", name) for name in SPACE.targets}
