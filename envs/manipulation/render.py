"""Pictures of a table from above, the robot's side on top."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from envs.manipulation.dynamics import GOAL_RADIUS, State
from envs.manipulation.table import BLOCK, CAN_RADIUS, CELL, COLUMNS, ROADBLOCK_HEIGHT, ROWS, Obstacles, Task

HOLE, SURFACE, SEAM = (40, 40, 46), (226, 203, 168), (206, 182, 146)
LOW, HIGH = (140, 104, 72), (92, 62, 40)
"""Colours of obstacles as high as a roadblock, and of those three times as high."""

GOAL_COLOR = (0, 190, 200)
CAN_COLORS = ((40, 80, 220), (40, 160, 60), (150, 150, 150))
RIM = (20, 20, 20)

SAMPLES = 3
"""Sample points per pixel and axis, averaged to smooth edges."""

LINE = 0.006
"""Metres: width of rims and rings."""

Color = tuple[int, int, int] | Float[np.ndarray, "3"]
Image = Float[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]
Points = Float[np.ndarray, "height width 2"]


def render(task: Task, state: State | None = None, *, tile_size: int = 32) -> UInt8[np.ndarray, "height width 3"]:
    """RGB picture of a task, `tile_size` pixels per block, in `state` or (None) as it starts; runs on the host.

    Cyan: the goal as a ring of radius r1, and a thin one of r2.  Blue: the can to be pushed there; green and grey: the others.

    Raises:
      ValueError: if `tile_size` is below 1.
    """
    if tile_size < 1:
        raise ValueError(f"tile_size must be at least 1, got {tile_size}")
    task, state = jax.device_get((task, state))
    cans, goal = (state.cans, state.goal) if state is not None else (task.cans, task.goal)
    width, height = COLUMNS * tile_size, ROWS * tile_size
    ticks = [(np.arange(size * SAMPLES) + 0.5) * BLOCK / (tile_size * SAMPLES) for size in (width, height)]
    points = np.stack(np.meshgrid(*ticks), axis=-1)

    cells = (points / CELL).astype(int)
    image = np.where(task.ground[cells[..., 0], cells[..., 1], None], np.array(SURFACE, float), np.array(HOLE, float))
    seam = np.abs((points + BLOCK / 2) % BLOCK - BLOCK / 2).min(axis=-1) < LINE / 4
    image = _paint(image, seam & task.ground[cells[..., 0], cells[..., 1]], SEAM)
    image = _goal(image, points, np.asarray(goal), float(task.goal_range))
    image = _obstacles(image, points, task.obstacles)
    for place, present, color in zip(cans, task.present, CAN_COLORS, strict=True):
        if present:
            away = np.linalg.norm(points - place, axis=-1)
            image = _paint(_paint(image, away <= CAN_RADIUS, RIM), away <= CAN_RADIUS - LINE, color)
    samples = image.reshape(height, SAMPLES, width, SAMPLES, 3)
    return samples.mean(axis=(1, 3)).round().astype(np.uint8)


def _paint(image: Image, mask: Mask, color: Color) -> Image:
    return np.where(mask[..., None], np.array(color, float), image)


def _goal(image: Image, points: Points, goal: Float[np.ndarray, "2"], goal_range: float) -> Image:
    away = np.linalg.norm(points - goal, axis=-1)
    inside = away <= GOAL_RADIUS
    image = np.where(inside[..., None], 0.6 * image + 0.4 * np.array(GOAL_COLOR), image)
    image = _paint(image, inside & (away > GOAL_RADIUS - LINE), GOAL_COLOR)
    return _paint(image, np.abs(away - goal_range) <= LINE / 4, GOAL_COLOR)


def _obstacles(image: Image, points: Points, obstacles: Obstacles) -> Image:
    """The higher, the darker."""
    for center, half, axis, rounding, height in zip(*obstacles, strict=True):
        if height <= 0:
            continue
        offset = points - center
        along = np.abs(offset @ axis) - half[0]
        across = np.abs(offset @ np.array([-axis[1], axis[0]])) - half[1]
        outside = np.hypot(np.maximum(along, 0), np.maximum(across, 0)) + np.minimum(np.maximum(along, across), 0)
        share = np.clip((height / ROADBLOCK_HEIGHT - 1) / 2, 0, 1)
        color = (1 - share) * np.array(LOW) + share * np.array(HIGH)
        image = _paint(_paint(image, outside <= rounding, RIM), outside <= rounding - LINE / 2, color)
    return image
