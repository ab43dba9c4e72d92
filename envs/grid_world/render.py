"""Pictures of a board in the familiar look of MiniGrid: one cached sprite per kind of tile."""

from __future__ import annotations

from functools import cache

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from envs.grid_world.board import BOARD, CATEGORIES, GOAL, OBJECTS, Task
from envs.grid_world.dynamics import State, initial_state, visible_objects

RED, GREEN, BLUE, YELLOW = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)
BLACK, GREY, ORANGE = (0, 0, 0), (100, 100, 100), (255, 128, 0)

SAMPLES = 4
"""Sample points per pixel and axis, averaged to smooth slanted edges."""

AGENT_SPRITE = CATEGORIES + OBJECTS
AGENT_ON_GOAL_SPRITE = AGENT_SPRITE + 1

Color = tuple[int, int, int]
Coordinates = Float[np.ndarray, "size size"]
Mask = Bool[np.ndarray, "size size"]
Sprite = UInt8[np.ndarray, "tile tile 3"]


def render(task: Task, state: State | None = None, *, tile_size: int = 32) -> UInt8[np.ndarray, "height width 3"]:
    """RGB picture of a task, `tile_size` pixels per tile, in `state` or (None) as it starts; runs on the host.

    Raises:
      ValueError: if `tile_size` is below 1.
    """
    if tile_size < 1:
        raise ValueError(f"tile_size must be at least 1, got {tile_size}")
    state = initial_state() if state is None else state
    task, state, visible = jax.device_get((task, state, visible_objects(state.keys, task)))
    row, column = state.position
    on_goal = visible[GOAL] and np.array_equal(task.objects[GOAL], state.position)

    kinds = task.tiles.astype(np.intp)
    rows, columns = task.objects[visible].T
    kinds[rows, columns] = CATEGORIES + np.flatnonzero(visible)
    kinds[row, column] = AGENT_ON_GOAL_SPRITE if on_goal else AGENT_SPRITE
    picture = sprites(tile_size)[kinds]  # [row, column, y, x, RGB]
    return picture.swapaxes(1, 2).reshape(BOARD * tile_size, BOARD * tile_size, 3)


@cache
def sprites(tile_size: int) -> UInt8[np.ndarray, "kinds tile tile 3"]:
    """All sprites: tile categories, then objects, then the agent on floor and on the goal."""
    ticks = (np.arange(tile_size * SAMPLES) + 0.5) / (tile_size * SAMPLES)
    x, y = np.meshgrid(ticks, ticks)
    floor = _paint(_paint(np.zeros((*x.shape, 3)), x >= 0, BLACK), (x < 0.03) | (y < 0.03), GREY)
    goal = _paint(floor, x >= 0, GREEN)
    kinds = [
        floor,
        _paint(floor, x >= 0, GREY),
        _lava(floor, x, y),
        goal,
        _door(floor, x, y, YELLOW),
        _door(floor, x, y, BLUE),
        _key(floor, x, y, YELLOW),
        _key(floor, x, y, BLUE),
        _agent(floor, x, y),
        _agent(goal, x, y),
    ]
    return np.stack([_downsample(image, tile_size) for image in kinds])


def _paint(image: Float[np.ndarray, "size size 3"], mask: Mask, color: Color) -> Float[np.ndarray, "size size 3"]:
    """`image` with `color` where `mask` holds."""
    return np.where(mask[..., None], np.array(color, np.float64), image)


def _downsample(image: Float[np.ndarray, "size size 3"], tile_size: int) -> Sprite:
    """The mean of every pixel's sample points."""
    samples = image.reshape(tile_size, SAMPLES, tile_size, SAMPLES, 3)
    return samples.mean(axis=(1, 3)).round().astype(np.uint8)


def _box(x: Coordinates, y: Coordinates, left: float, right: float, top: float, bottom: float) -> Mask:
    return (left <= x) & (x < right) & (top <= y) & (y < bottom)


def _disc(x: Coordinates, y: Coordinates, center: tuple[float, float], radius: float) -> Mask:
    return (x - center[0]) ** 2 + (y - center[1]) ** 2 <= radius**2


def _lava(image: np.ndarray, x: Coordinates, y: Coordinates) -> np.ndarray:
    """Orange with three dark waves."""
    zigzag = 0.1 * np.abs((4 * x) % 2 - 1)
    waves = np.any([np.abs(y - height - zigzag) < 0.02 for height in (0.2, 0.45, 0.7)], axis=0)
    return _paint(_paint(image, x >= 0, ORANGE), waves, BLACK)


def _door(image: np.ndarray, x: Coordinates, y: Coordinates, color: Color) -> np.ndarray:
    """A dim panel in a bright frame, with a keyhole."""
    dim = (color[0] * 2 // 5, color[1] * 2 // 5, color[2] * 2 // 5)
    keyhole = _disc(x, y, (0.72, 0.46), 0.08) | _box(x, y, 0.69, 0.75, 0.46, 0.64)
    return _paint(_paint(_paint(image, x >= 0, color), _box(x, y, 0.08, 0.92, 0.08, 0.92), dim), keyhole, color)


def _key(image: np.ndarray, x: Coordinates, y: Coordinates, color: Color) -> np.ndarray:
    """A ring above a shaft with two teeth."""
    ring = _disc(x, y, (0.55, 0.28), 0.18) & ~_disc(x, y, (0.55, 0.28), 0.08)
    shaft = _box(x, y, 0.49, 0.61, 0.42, 0.88)
    teeth = _box(x, y, 0.36, 0.49, 0.62, 0.69) | _box(x, y, 0.36, 0.49, 0.80, 0.88)
    return _paint(image, ring | shaft | teeth, color)


def _agent(image: np.ndarray, x: Coordinates, y: Coordinates) -> np.ndarray:
    """A red triangle; it points right at all times, since this agent has no heading."""
    return _paint(image, (x >= 0.14) & (np.abs(y - 0.5) <= 0.5 * (0.88 - x)), RED)
