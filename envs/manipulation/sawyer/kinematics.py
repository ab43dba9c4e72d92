"""Where the tool's tip is, and the joint angles that bring it to a pose, by damped least squares (Wampler 1986)."""

from __future__ import annotations

import functools
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from envs.manipulation.sawyer.arm import LINKS, arm_xml

JOINTS = len(LINKS)

DAMPING = 1e-3
"""Weight of the joints' motion against the pose's error, where a metre counts as much as a radian."""

REST = np.array([0.0, -1.18, 0.3, 2.18, -0.3, 0.57, 1.0])
"""The robot's neutral pose, hand down, with the elbow swung aside: where the one freedom that a pose leaves is drawn to.  With
the elbow straight up, the arm would be stretched out before its hand is over the far corners."""

SPEEDS = np.array([link.speed for link in LINKS])
"""Radians per second of each joint, at most."""

EASE, MOST_EASE = 0.02, 2e-4 * SPEEDS * (np.arange(JOINTS) < JOINTS - 1)
"""Share of the way to `REST` per iteration, and radians at most: a fifth of the speed limits, at 1000 iterations a second; the
last joint is not drawn there."""

CLOSE = 1e-6
"""Metres and radians that end the iterations."""

IDENTITY = np.eye(6)

Array = Any
"""Of numpy or of JAX."""

Joints = Float[np.ndarray, "7"]
Point = Float[np.ndarray, "3"]
Rotation = Float[np.ndarray, "3 3"]


@functools.cache
def arm_model() -> mujoco.MjModel:
    """The robot without a table."""
    return mujoco.MjModel.from_xml_string(arm_xml())


@functools.cache
def limits() -> Float[np.ndarray, "7 2"]:
    """Lower and upper limit of each joint, in radians."""
    return np.array([link.limits for link in LINKS])


def closer(joints: Array, error: Array, jacobian: Array) -> Array:
    """Joint angles [7] one iteration closer to a pose of the tip, in radians, never beyond the joints' limits.

    Args:
      joints: where they are [7]; arrays are those of numpy or of JAX, whichever is given.
      error: what is missing to the pose [6]: a translation in metres and a turn as axis times angle.
      jacobian: of the tip [6, 7], by joint: how it moves and turns.
    """
    xp = joints.__array_namespace__()
    ease = xp.clip(EASE * (REST - joints), -MOST_EASE, MOST_EASE)
    damped = xp.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * IDENTITY, error - jacobian @ ease)
    return xp.clip(joints + ease + jacobian.T @ damped, *limits().T)


class Kinematics:
    """The arm's geometry at one posture at a time."""

    def __init__(self) -> None:
        self.model = arm_model()
        self.data = mujoco.MjData(self.model)
        self.tip = self.model.site("tip").id

    def pose(self, joints: Joints) -> tuple[Point, Rotation]:
        """Place of the tip, in metres, and the rotation that takes its axes to the world's."""
        self.data.qpos[:] = joints
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.site_xpos[self.tip].copy(), self.data.site_xmat[self.tip].reshape(3, 3).copy()

    def approach(self, joints: Joints, point: Point, rotation: Rotation, iterations: int = 1) -> Joints:
        """Joint angles closer to a pose of the tip, see `closer`."""
        for _ in range(iterations):
            error = np.concatenate(self._error(joints, point, rotation))
            if iterations > 1 and np.abs(error).max() < CLOSE:
                break
            mujoco.mj_comPos(self.model, self.data)
            jacobian = np.empty((6, JOINTS))
            mujoco.mj_jacSite(self.model, self.data, jacobian[:3], jacobian[3:], self.tip)
            joints = closer(joints, error, jacobian)
        return joints

    def _error(self, joints: Joints, point: Point, rotation: Rotation) -> tuple[Point, Point]:
        """What is missing to a pose: a translation, and a turn as axis times angle."""
        at, turned = self.pose(joints)
        turn = np.empty(3)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, (rotation @ turned.T).ravel())
        mujoco.mju_quat2Vel(turn, quaternion, 1.0)
        return point - at, turn
