"""The table, the cans and the robot as one MuJoCo model, lit and coloured."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Bool, Float

from envs.manipulation.dynamics import GOAL_RADIUS
from envs.manipulation.render import CAN_COLORS, GOAL_COLOR, LOW, SURFACE
from envs.manipulation.sawyer.arm import HEIGHT, arm_xml
from envs.manipulation.table import CANS, CELL, PIT_DEPTH, SIZE, Task
from envs.manipulation.table_scene import table_xml

BOARD, RIM, LEG = 0.03, 0.06, 0.03
"""Metres: thickness of the board under the blocks, how far it reaches beyond them, and half the thickness of its legs."""

BOARD_COLOR, FLOOR_COLOR = (120, 120, 124), (196, 200, 204)

STRIP = 0.004
"""Metres: width of the strips that the goal's disc is drawn with."""

PREFIX = "sawyer/"
"""Before the names of all that is the robot's."""

Array = Any
"""Of numpy or of JAX."""

PICTURE = (480, 360)
"""Pixels of a picture."""


def mirror(task: Task) -> Task:
    """The task as the robot sees it: x runs the other way."""
    obstacles = task.obstacles
    seen = obstacles._replace(center=mirror_places(obstacles.center), axis=obstacles.axis * np.array([[-1, 1]], np.float32))
    return task._replace(
        ground=jnp.asarray(task.ground)[::-1],
        obstacles=jax.tree.map(jnp.asarray, seen),
        cans=jnp.where(jnp.asarray(task.present)[:, None], mirror_places(task.cans), task.cans),
        goal=jnp.asarray(mirror_places(task.goal)),
    )


def mirror_places(places: Array) -> Array:
    """(x, y) of a task [..., 2] as the robot sees them, and the other way round; of numpy or of JAX, whichever is given."""
    return places.__array_namespace__().stack([SIZE[0] - places[..., 0], places[..., 1]], axis=-1)


def stage(task: Task, goal: Float[np.ndarray, "2"]) -> mujoco.MjModel:
    """Model of a task as the robot sees it, with a disc where the goal is; cans are `can0` to `can2`."""
    spec = mujoco.MjSpec.from_string(table_xml(task, np.asarray(task.cans, float)))
    for geom in spec.geoms:
        geom.rgba = _color(geom.name)
    world = spec.worldbody
    half = [(size + 2 * RIM) / 2 for size in SIZE]
    center = [size / 2 for size in SIZE]
    box, plane = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE
    world.add_geom(type=box, pos=[*center, -PIT_DEPTH - BOARD / 2], size=[*half, BOARD / 2], rgba=_opaque(BOARD_COLOR))
    legs = HEIGHT - PIT_DEPTH - BOARD
    for side, end in itertools.product((-1, 1), repeat=2):
        place = [center[0] + side * (half[0] - LEG), center[1] + end * (half[1] - LEG), -HEIGHT + legs / 2]
        world.add_geom(type=box, pos=place, size=[LEG, LEG, legs / 2], rgba=_opaque(BOARD_COLOR), contype=0, conaffinity=0)
    world.add_geom(type=plane, pos=[0, 0, -HEIGHT], size=[0, 0, 1], rgba=_opaque(FLOOR_COLOR))
    for x, y, length in _strips(goal, np.asarray(task.ground)):
        world.add_geom(
            type=box, pos=[x, y, 0], size=[length / 2, STRIP / 2, 0.001], rgba=_opaque(GOAL_COLOR), contype=0, conaffinity=0
        )
    lamp = [center[0] + 0.6, center[1] + 1.0, 2.5]
    world.add_light(pos=lamp, dir=[-0.6, -1.2, -2.5], cutoff=60, exponent=1, diffuse=[0.5, 0.5, 0.5], specular=[0, 0, 0])
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35, 0.35, 0.35], [0.2, 0.2, 0.2]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = PICTURE
    spec.attach(mujoco.MjSpec.from_string(arm_xml()), prefix=PREFIX, frame=world.add_frame())
    return spec.compile()


def _strips(goal: Float[np.ndarray, "2"], ground: Bool[np.ndarray, "36 24"]) -> Iterator[tuple[float, float, float]]:
    """Centre and length of the pieces of the goal's disc that lie on the surface, in strips along x."""
    for y in np.arange(-GOAL_RADIUS + STRIP / 2, GOAL_RADIUS, STRIP):
        reach = np.sqrt(GOAL_RADIUS**2 - y**2)
        left, right = goal[0] - reach, goal[0] + reach
        edges = np.array([left, *(CELL * k for k in range(len(ground) + 1) if left < CELL * k < right), right])
        middles = (edges[1:] + edges[:-1]) / 2
        for middle, length in zip(middles, np.diff(edges), strict=True):
            column, row = int(middle // CELL), int((goal[1] + y) // CELL)
            if 0 <= column < ground.shape[0] and 0 <= row < ground.shape[1] and ground[column, row]:
                yield float(middle), float(goal[1] + y), float(length)


def _color(name: str) -> list[float]:
    cans = {f"can{index}": CAN_COLORS[index] for index in range(CANS)}
    return _opaque(cans.get(name, SURFACE if name.startswith("ground") else LOW))


def _opaque(color: tuple[int, int, int]) -> list[float]:
    return [*(channel / 255 for channel in color), 1.0]
