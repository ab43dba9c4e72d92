"""Tables to push cans about on, and one compiled push for all tests of a file."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.manipulation.push import push

RIGHT, AWAY, LEFT, NEAR = range(4)
FLAT, PIT, ROADBLOCK = range(3)
BLUE, GREEN, GREY = range(3)

SPACE = envs.make("manipulation")
EMPTY = "\n".join(["FFFFFF"] * 4)
BATCH = 40
"""Pushes per call of the one compiled program."""


def table(*cans, rows=EMPTY, extra="", reach=10):
    """The task with cans at (x, y) in centimetres."""
    places = "\n".join(f"can {x} {y}" for x, y in cans)
    return SPACE.parse_target(f"{rows}\n{places}\n{extra}\nrange {reach}")


@functools.cache
def _program():
    def one(task, can, direction):
        return push(task, task.cans, task.present, can=can, direction=direction)

    return jax.jit(jax.vmap(one))


def push_all(cases):
    """Outcomes of (task, can, direction) cases, leaves [n, ...], fetched."""
    padded = [*cases, *[cases[-1]] * (-len(cases) % BATCH)]
    parts = []
    for first in range(0, len(padded), BATCH):
        tasks, cans, directions = zip(*padded[first : first + BATCH], strict=True)
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *tasks)
        parts.append(jax.device_get(_program()(stacked, np.array(cans, np.int32), np.array(directions, np.int32))))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(cases)], *parts)


@functools.cache
def _step():
    return jax.jit(SPACE.step)


def play(task, actions, goal=None, *, whole=True):
    """The step outputs of (can, direction) pairs from the start of an episode whose goal is the task's, or `goal` in metres.

    Pushes beyond the end of the episode are a mistake, unless it need not be the `whole` plan.
    """
    state, _ = SPACE.reset(jax.random.key(0), task)
    state = state._replace(goal=jnp.asarray(task.goal if goal is None else goal, jnp.float32))
    outs = []
    for can, direction in actions:
        if outs and (outs[-1].terminated or outs[-1].truncated):
            assert not whole, "the episode is over"
            break
        outs.append(_step()(state, jnp.int32(4 * can + direction), task))
        state = outs[-1].state
    return outs


def params(blocks=(), cans=(), offset=(0.0,) * 6, reach=0.3):
    """A parameter with categories `blocks` {(column, row): category} on flat ones, and cans on blocks {index: (column, row)}.

    Cans that are not named share the block of the first one, hence do not appear.
    """
    scores = np.zeros((6, 4, 3), np.float32)
    scores[..., FLAT] = 1
    for place, category in dict(blocks).items():
        scores[place] = np.eye(3)[category]
    cans = dict(cans)
    placement = np.zeros((3, 24), np.float32)
    for index in range(3):
        column, row = cans.get(index, cans.get(0, (0, 0)))
        placement[index, 4 * column + row] = 1
    return {
        "blocks": jnp.asarray(scores),
        "placement": jnp.asarray(placement),
        "offset": jnp.asarray(offset, jnp.float32),
        "goal_range": jnp.full(1, reach, jnp.float32),
    }
