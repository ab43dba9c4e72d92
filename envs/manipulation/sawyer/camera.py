"""Pictures of the simulation, drawn off screen by OpenGL."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import sys
from typing import Any

import mujoco
import numpy as np
from jaxtyping import UInt8

from envs.manipulation.sawyer.arm import BASE
from envs.manipulation.sawyer.stage import PICTURE

LOOK_AT = (BASE[0], 0.10, 0.19)
DISTANCE, AZIMUTH, ELEVATION = 1.85, -90.0, -33.0
"""What the camera faces, on the robot's axis, from how many metres away, and from where, in degrees: across the table, so that
the robot is at the back and x runs to the right, as in the picture from above."""

LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
"""What draws without a window on Linux, and the library it needs."""


class NoGraphics(RuntimeError):
    """This machine cannot draw; the message says what would."""


class Camera:
    """Draws one model; close it when done.

    Raises:
      NoGraphics: if there is no OpenGL, or it does not start.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.context = _context()
        self.context.make_current()
        self.scene = mujoco.MjvScene(model, maxgeom=2000)
        try:
            self.renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except mujoco.FatalError as error:
            raise NoGraphics(f"OpenGL does not start: {error}") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.renderer)
        self.model, self.option, self.view = model, mujoco.MjvOption(), mujoco.MjvCamera()
        self.view.lookat, self.view.distance = LOOK_AT, DISTANCE
        self.view.azimuth, self.view.elevation = AZIMUTH, ELEVATION

    def picture(self, data: mujoco.MjData) -> UInt8[np.ndarray, "360 480 3"]:
        """RGB picture of the simulation as it is."""
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, data, self.option, None, self.view, everything, self.scene)
        rectangle, pixels = mujoco.MjrRect(0, 0, *PICTURE), np.empty((PICTURE[1], PICTURE[0], 3), np.uint8)
        mujoco.mjr_render(rectangle, self.scene, self.renderer)
        mujoco.mjr_readPixels(pixels, None, rectangle, self.renderer)
        return pixels[::-1]

    def close(self) -> None:
        """Gives the graphics back."""
        self.renderer.free()
        self.context.free()


def backend() -> str:
    """How to draw here: what MUJOCO_GL says, else the first of `LIBRARIES` that is installed; raises `NoGraphics`."""
    named = os.environ.get("MUJOCO_GL", "")
    found = named or next((name for name, library in LIBRARIES.items() if ctypes.util.find_library(library)), "")
    if not found:
        raise NoGraphics("no OpenGL to draw with: install EGL (Debian and Ubuntu: libegl1 libopengl0) or OSMesa (libosmesa6)")
    return found


def _context() -> Any:
    if sys.platform != "linux":
        return mujoco.GLContext(*PICTURE)
    name = backend()
    if name not in LIBRARIES:
        raise NoGraphics(f"MUJOCO_GL is {name!r}, allowed are {' and '.join(LIBRARIES)}")
    os.environ["MUJOCO_GL"] = name  # MuJoCo itself asks where to find OpenGL's functions.
    try:
        return importlib.import_module(f"mujoco.{name}").GLContext(*PICTURE)
    except (ImportError, AttributeError, RuntimeError) as error:  # what PyOpenGL and MuJoCo raise where a driver is missing
        raise NoGraphics(f"{name} does not start: {error}") from error
