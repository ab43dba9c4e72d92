"""Films of the arm playing an episode, and pictures of it in front of a task."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from envs.manipulation.sawyer.camera import Camera
from envs.manipulation.sawyer.replay import Push, Scene, replay
from envs.manipulation.sawyer.stage import mirror, mirror_places
from envs.manipulation.table import Task

FRAME_SECONDS = 0.16
"""Simulated seconds from one picture to the next."""

FPS = 12.5
"""Pictures per second that show it twice as fast as it is."""


def film(
    task: Task, goal: Float[np.ndarray, "2"], actions: Sequence[int]
) -> tuple[list[UInt8[np.ndarray, "360 480 3"]], list[Push]]:
    """Pictures of an episode, and what its pushes did (see `replay`).

    Raises:
      NoGraphics: before anything is simulated, if this machine cannot draw.
    """
    frames: list[UInt8[np.ndarray, "360 480 3"]] = []
    with contextlib.ExitStack() as stack:
        cameras: list[Camera] = []

        def watch(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            if not cameras:
                cameras.append(stack.enter_context(contextlib.closing(Camera(model))))
            if data.time >= FRAME_SECONDS * len(frames):
                frames.append(cameras[0].picture(data))

        pushes = replay(task, goal, actions, watch)
    return frames, pushes


def picture(task: Task) -> UInt8[np.ndarray, "360 480 3"]:
    """A task as it starts, the arm at rest; raises `NoGraphics` if this machine cannot draw."""
    scene = Scene(mirror(task), mirror_places(np.asarray(task.goal, float)))
    with contextlib.closing(Camera(scene.model)) as camera:
        return camera.picture(scene.data)
