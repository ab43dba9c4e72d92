"""How the arm moves: over the table to behind a can, the stroke of the task space's push, and back off."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from envs.manipulation.push import GAP, STROKE, STROKE_SECONDS
from envs.manipulation.sawyer.arm import BASE
from envs.manipulation.sawyer.kinematics import REST, Kinematics, Rotation
from envs.manipulation.scene import TOOL_HALF, TOOL_HEIGHT
from envs.manipulation.table import CAN_HEIGHT, CAN_RADIUS, Task, distances
from envs.manipulation.table_scene import TIMESTEP

LEAN_FROM, LEAN_TO = 0.88, 1.03
LEAN = 0.2
"""Metres from the robot's axis from which on the tool leans outwards, and to which, by how much in radians: the arm is too
short to hold it upright everywhere."""

SPARE = 0.03
"""Metres between the tool's tip and what it crosses."""

WIDTH = 0.06
"""Metres beside its way within which the tool keeps above everything."""

POINTS = 64
"""Points of a way that are looked at, at most 2 cm apart."""

CROSS_SECONDS, SPEED, TURN_SPEED = 0.2, 0.35, 2.5
"""How long the tool takes to cross the table: seconds however close, and mean metres and radians per second."""

RISE_SECONDS, RISE_SPEED = 0.3, 0.4
"""Seconds to rise or sink at least, and mean metres per second at most."""

HOLD_SECONDS, RETREAT, RETREAT_SECONDS = 0.15, 0.015, 0.15
"""After a stroke the tool waits for the can to come to rest, then leaves it backwards before it rises."""

Pose = Float[np.ndarray, "6"]
"""x, y and z of the tip, the angle of its normal about the vertical, and its lean: a turn about a horizontal axis, as the x and
y of axis times angle."""


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
        self.pose = _pose(start, self._clear(start, start), 0.0, lean(start))
        self.joints = self.kinematics.approach(REST, self.pose[:3], rotation(self.pose), iterations=300)

    def push(self, place: Float[np.ndarray, "2"], ahead: Float[np.ndarray, "2"]) -> Plan:
        """From where the arm is, pushes a can at `place` in the direction `ahead`, which is along x or y."""
        heading, leaning = _heading(ahead), lean(place)
        behind = place - ahead * (CAN_RADIUS + GAP + _extent(heading, leaning, ahead))
        height = self._clear(self.pose[:2], behind)
        above = _pose(behind, height, heading, leaning)
        down = _pose(behind, TOOL_HEIGHT, heading, leaning)
        done = down + np.pad(ahead * (STROKE + GAP), (0, 4))
        back = done - np.pad(ahead * RETREAT, (0, 4))
        up = self.pose.copy()
        up[2] = max(height, up[2])
        cross = CROSS_SECONDS + max(float(np.linalg.norm(above[:2] - up[:2])) / SPEED, abs(above[3] - up[3]) / TURN_SPEED)
        legs = [
            (up, max(RISE_SECONDS, (up[2] - self.pose[2]) / RISE_SPEED)),
            (above, cross),
            (down, max(RISE_SECONDS, (above[2] - down[2]) / RISE_SPEED)),
            (done, STROKE_SECONDS),
            (done, HOLD_SECONDS),
            (back, RETREAT_SECONDS),
        ]
        parts, pose = [], self.pose
        for end, seconds in legs:
            parts.append(pose + _progress(seconds)[:, None] * (end - pose))
            pose = end
        first = sum(len(part) for part in parts[:3])
        poses = np.concatenate(parts)
        joints = self._follow(poses)
        self.pose, self.joints = pose, joints[-1]
        speeds = np.gradient(joints, TIMESTEP, axis=0)
        return Plan(joints, speeds, np.gradient(speeds, TIMESTEP, axis=0), poses[:, :3], (first, first + len(parts[3])))

    def _follow(self, poses: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n 7"]:
        joints, rows = self.joints, []
        for pose in poses:
            joints = self.kinematics.approach(joints, pose[:3], rotation(pose))
            rows.append(joints)
        return np.array(rows)

    def _clear(self, start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]) -> float:
        """Height of the tip's centre above cans, and obstacles close to a straight way."""
        way = jnp.asarray(np.linspace(start, end, POINTS), jnp.float32)
        near = np.asarray(jax.vmap(distances, in_axes=(None, 0))(self.task.obstacles, way)) < WIDTH
        highest = float(np.max(np.where(near, self.task.obstacles.height, 0.0)))
        return max(highest, CAN_HEIGHT) + SPARE + TOOL_HALF[2]


def _heading(ahead: Float[np.ndarray, "2"]) -> float:
    """The angle of a direction along x or y, from -pi / 2 to pi: so the last joint stays far from its limits."""
    return float(np.arctan2(ahead[1] + 0.0, ahead[0]))  # -0.0 would give -pi


def lean(place: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """Lean of the tool for a push from `place`: away from the robot, the more the farther."""
    outwards = place - np.array(BASE)
    far = float(np.linalg.norm(outwards))
    angle = LEAN * np.clip((far - LEAN_FROM) / (LEAN_TO - LEAN_FROM), 0, 1)
    x, y = outwards / far
    turned: Float[np.ndarray, "2"] = angle * np.array([y, -x])
    return turned


def rotation(pose: Pose) -> Rotation:
    """From the tip's axes to the world's: z down along the stick, x its normal, both turned by the lean."""
    cosine, sine = np.cos(pose[3]), np.sin(pose[3])
    upright = np.array([[cosine, sine, 0], [sine, -cosine, 0], [0, 0, -1]])
    angle = float(np.hypot(pose[4], pose[5]))
    if angle == 0:
        return upright
    x, y = pose[4:] / angle
    cross = np.array([[0, 0, y], [0, 0, -x], [-y, x, 0]])
    turn: Rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turn @ upright


def _pose(place: Float[np.ndarray, "2"], height: float, heading: float, leaning: Float[np.ndarray, "2"]) -> Pose:
    return np.array([*place, height, heading, *leaning])


def _extent(heading: float, leaning: Float[np.ndarray, "2"], ahead: Float[np.ndarray, "2"]) -> float:
    """How far the tip reaches beyond its centre."""
    turned = rotation(_pose(ahead, 0.0, heading, leaning))
    return float(np.abs(np.array([*ahead, 0]) @ turned) @ np.array(TOOL_HALF))


def _progress(seconds: float) -> Float[np.ndarray, "n"]:
    """Share of the way gone after each time step: half a period of a cosine, as in the task space's stroke."""
    steps = round(seconds / TIMESTEP)
    shares: Float[np.ndarray, "n"] = (1 - np.cos(np.pi * np.arange(1, steps + 1) / steps)) / 2
    return shares
