"""How the arm moves: over the table to behind a can, the stroke of the task space's push, and back off."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.manipulation.push import GAP, STROKE, STROKE_SECONDS
from envs.manipulation.sawyer.arm import BASE
from envs.manipulation.sawyer.kinematics import REST, SPEEDS, Kinematics
from envs.manipulation.sawyer.pose import behind, lean, rotation
from envs.manipulation.scene import TOOL_HALF
from envs.manipulation.table import CAN_HEIGHT, Task, distances
from envs.manipulation.table_scene import TIMESTEP

SPARE = 0.03
"""Metres between the tool's tip and what it crosses."""

WIDTH = 0.06
"""Metres beside its way within which the tool keeps above everything."""

POINTS = 64
"""Points of a way that are looked at, at most 2 cm apart."""

RISE_SECONDS, CROSS_SECONDS, CROSS_SPEED = 0.3, 0.2, 0.35
"""Seconds to rise or sink, and to cross the table: seconds however close, and mean metres per second of the tip."""

ATTEMPTS, PATIENCE, MOST_PATIENCE = 5, 1.02, 2.0
"""How often a motion that is too fast for a joint is tried again, how much longer it takes each time than it seems to need, and
how much longer at most: where the arm is stretched out, a joint may turn fast however slow the tip is."""

HOLD_SECONDS, RETREAT, RETREAT_SECONDS = 0.15, 0.015, 0.15
"""After a stroke the tool waits for the can to come to rest, then leaves it backwards before it rises."""

Pose = Float[np.ndarray, "6"]
"""See `pose`."""


class Plan(NamedTuple):
    """Joint angles of a motion, one row per time step, with speeds and accelerations.

    Attributes:
      stroke: first and one past the last time step of the stroke.
      points: where the tip is meant to be.
    """

    joints: Float[np.ndarray, "n 7"]
    speeds: Float[np.ndarray, "n 7"]
    accelerations: Float[np.ndarray, "n 7"]
    points: Float[np.ndarray, "n 3"]
    stroke: tuple[int, int]


class Planner:
    """Plans one push after the other, each from where the last one ended, the first from over the table in front of the robot.

    Attributes:
      joints: the joints' angles where the next plan starts.
      pose: the tip's pose there.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.kinematics = Kinematics()
        start = np.array([BASE[0], BASE[1] + 0.45])
        self.pose: Pose = np.array([*start, self._clear(start, start), 0.0, *lean(start)])
        self.joints = self.kinematics.approach(REST, self.pose[:3], rotation(self.pose), iterations=300)

    def push(self, place: Float[np.ndarray, "2"], ahead: Float[np.ndarray, "2"]) -> Plan:
        """From where the arm is, pushes a can at `place` in the direction `ahead`, which is along x or y.

        Joints keep to their limits of position, and of speed but for the stroke, whose time is the task space's.
        """
        down = behind(place, ahead)
        above = down.copy()
        above[2] = height = self._clear(self.pose[:2], down[:2])
        done = down + np.pad(ahead * (STROKE + GAP), (0, 4))
        back = done - np.pad(ahead * RETREAT, (0, 4))
        up = self.pose.copy()
        up[2] = max(height, up[2])
        cross = CROSS_SECONDS + float(np.linalg.norm(above[:2] - up[:2])) / CROSS_SPEED
        before = [self._move(up, RISE_SECONDS), self._move(above, cross), self._move(down, RISE_SECONDS)]
        stroke = self._move(done, STROKE_SECONDS, in_time=True)
        after = [self._move(done, HOLD_SECONDS), self._move(back, RETREAT_SECONDS)]
        poses, joints = (np.concatenate(parts) for parts in zip(*before, stroke, *after, strict=True))
        first = sum(len(part) for part, _ in before)
        speeds = np.gradient(joints, TIMESTEP, axis=0)
        accelerations = np.gradient(speeds, TIMESTEP, axis=0)
        return Plan(joints, speeds, accelerations, poses[:, :3], (first, first + len(stroke[0])))

    def _move(
        self, end: Pose, seconds: float, in_time: bool = False
    ) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 7"]]:
        """Poses and joint angles on the straight way to a pose; slower where joints would turn too fast, unless `in_time`."""
        poses, joints, haste = self._follow(end, seconds)
        for _ in range(ATTEMPTS):
            if haste <= 1 or in_time:
                break
            seconds *= min(haste * PATIENCE, MOST_PATIENCE)
            poses, joints, haste = self._follow(end, seconds)
        self.pose, self.joints = end, joints[-1]
        return poses, joints

    def _follow(self, end: Pose, seconds: float) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 7"], float]:
        """Poses, joint angles, and how many times too fast a joint turns at most."""
        poses = self.pose + _progress(seconds)[:, None] * (end - self.pose)
        rows = [self.joints]
        for pose in poses:
            rows.append(self.kinematics.approach(rows[-1], pose[:3], rotation(pose)))
        joints = np.array(rows)
        haste = np.max(np.abs(np.diff(joints, axis=0)) / TIMESTEP / SPEEDS)
        return poses, joints[1:], float(haste)

    def _clear(self, start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]) -> float:
        """Height of the tip's centre above cans, and obstacles close to a straight way."""
        way = jnp.asarray(np.linspace(start, end, POINTS), jnp.float32)
        near = np.asarray(jax.vmap(distances, in_axes=(None, 0))(self.task.obstacles, way)) < WIDTH
        highest = float(np.max(np.where(near, self.task.obstacles.height, 0.0)))
        return max(highest, CAN_HEIGHT) + SPARE + TOOL_HALF[2]


def _progress(seconds: float) -> Float[np.ndarray, "n"]:
    """Share of the way gone after each time step: half a period of a cosine, as in the task space's stroke."""
    steps = round(seconds / TIMESTEP)
    shares: Float[np.ndarray, "n"] = (1 - np.cos(np.pi * np.arange(1, steps + 1) / steps)) / 2
    return shares
