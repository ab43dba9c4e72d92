"""A push simulated by MuJoCo itself, with cylinders, boxes and real collisions, step by step."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Float

from envs.manipulation import table_scene
from envs.manipulation.push import GAP, STROKE, STROKE_SECONDS, TOOL_START
from envs.manipulation.table import CAN_HEIGHT, DIRECTIONS, Task

SECONDS = 2.0
REST = 1e-3
"""Long enough for whatever leans to fall, and the speed (m/s and rad/s) below which nothing does."""


def push_scene(task: Task, can: int, direction: int) -> mujoco.MjModel:
    """The table with the tool behind a can."""
    ahead, cans = DIRECTIONS[direction].astype(float), np.asarray(task.cans, float)
    x, y = cans[can] + TOOL_START * ahead
    return mujoco.MjModel.from_xml_string(table_scene.table_xml(task, cans, (x, y, math.atan2(ahead[1], ahead[0]))))


def stroke(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> Iterator[float]:
    """Steps the scene, the tool on its way; yields the time at which each step began, in seconds."""
    tool = model.joint("tool")
    for step in range(round(seconds / model.opt.timestep)):
        began = step * model.opt.timestep
        phase = math.pi * min(began / STROKE_SECONDS, 1.0)
        half = (STROKE + GAP) / 2
        data.qpos[tool.qposadr] = half * (1 - math.cos(phase))
        data.qvel[tool.dofadr] = half * math.pi / STROKE_SECONDS * math.sin(phase)
        mujoco.mj_step(model, data)
        yield began


def push(task: Task, can: int, direction: int) -> tuple[Float[np.ndarray, "2"], str]:
    """(x, y) of the pushed can, and one of "", "fell", "hit"; there must be room for the tool."""
    model = push_scene(task, can, direction)
    data = mujoco.MjData(model)
    body = model.body(f"can{can}").id
    geom, free = model.geom(f"can{can}").id, model.joint(f"can{can}")
    fatal = {i for i in range(model.ngeom) if model.geom(i).name.startswith(("obstacle", "can"))} - {geom}
    for seconds in stroke(model, data, SECONDS):
        place = data.xpos[body]
        if place[2] < CAN_HEIGHT / 2 - 0.02 or data.xmat[body][8] < 0.94:
            return place[:2].copy(), "fell"
        met = data.contact.geom[data.contact.dist <= 0]
        if fatal & set(met[(met == geom).any(axis=1)].ravel().tolist()):
            return place[:2].copy(), "hit"
        if seconds >= STROKE_SECONDS and abs(data.qvel[free.dofadr[0] :][:6]).max() < REST:
            break
    return data.xpos[body][:2].copy(), ""
