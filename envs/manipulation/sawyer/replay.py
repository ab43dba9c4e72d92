"""An episode played by the arm: its motors drive the tool, the tool pushes the cans, MuJoCo does the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from envs.manipulation.dynamics import GOAL_RADIUS
from envs.manipulation.push import FALL_COSINE, SUNK, TOOL_RADIUS, TOOL_START
from envs.manipulation.sawyer.kinematics import JOINTS, Joints
from envs.manipulation.sawyer.motion import Plan, Planner
from envs.manipulation.sawyer.servo import wanted
from envs.manipulation.sawyer.stage import PREFIX, mirror, mirror_places, stage
from envs.manipulation.table import ABSENT, CAN_HEIGHT, CAN_RADIUS, CANS, DIRECTIONS, TARGET, Task, distances

RATE = 300.0
"""How fast the joints come back to their course (1/s, see `servo`).  Hence an acceleration of 9e4 1/s^2 per radian."""

REST, REST_SECONDS = 1e-3, 2.0
"""Speed (m/s and rad/s) below which nothing moves any more, and how long to wait for that."""

LAST_SECONDS = 1.0
"""What is shown after an episode's end."""

Watch = Callable[[mujoco.MjModel, mujoco.MjData], None]
"""Told of the start and of every time step."""


class Push(NamedTuple):
    """What one push did.

    Attributes:
      cans: (x, y) of each can when all has come to rest or at the event; `ABSENT` if it does not appear.
      event: "" or "fell" or "hit": the pushed can falls, or met an obstacle or another can.
      success: the target is in the goal.
      tracking: metres that the tip was off its course during the stroke, at most.
    """

    cans: Float[np.ndarray, "3 2"]
    event: str
    success: bool
    tracking: float


def replay(task: Task, goal: Float[np.ndarray, "2"], actions: Sequence[int], watch: Watch | None = None) -> list[Push]:
    """Plays actions one after the other until the episode ends; all positions are those of the task.

    Pushes that the task space does not carry out, for want of the can or of room for the tool, are not tried.

    Args:
      goal: (x, y) of the goal's centre.
    """
    scene = Scene(mirror(task), mirror_places(np.asarray(goal, float)), watch)
    pushes: list[Push] = []
    for action in actions:
        can, direction = divmod(int(action), len(DIRECTIONS))
        event, tracking = scene.push(can, DIRECTIONS[direction].astype(float) * (-1, 1))
        cans = np.where(scene.task.present[:, None], mirror_places(scene.cans()), ABSENT)
        inside = bool(scene.task.present[TARGET]) and float(np.linalg.norm(cans[TARGET] - goal)) < GOAL_RADIUS
        pushes.append(Push(cans, event, not event and inside, tracking))
        if event or pushes[-1].success:
            break
    if watch:
        scene.wait(LAST_SECONDS)
    return pushes


class Scene:
    """The simulation of one episode, in the robot's view."""

    def __init__(self, task: Task, goal: Float[np.ndarray, "2"], watch: Watch | None = None) -> None:
        self.task, self.watch = task, watch
        self.model = stage(task, goal)
        self.data = mujoco.MjData(self.model)
        self.planner = Planner(task)
        joints = [self.model.joint(f"{PREFIX}right_j{index}") for index in range(JOINTS)]
        self.positions = np.array([joint.qposadr[0] for joint in joints])
        self.dofs = np.array([joint.dofadr[0] for joint in joints])
        self.motors = np.array([self.model.actuator(f"{PREFIX}right_j{index}").id for index in range(JOINTS)])
        self.tip = self.model.site(f"{PREFIX}tip").id
        there = [can for can in range(CANS) if task.present[can]]
        self.bodies = {can: self.model.body(f"can{can}").id for can in there}
        self.geoms = {can: self.model.geom(f"can{can}").id for can in there}
        names = [self.model.geom(geom).name for geom in range(self.model.ngeom)]
        self.fatal = {geom for geom, name in enumerate(names) if name.startswith(("obstacle", "can"))}
        self.goal_joints = self.planner.joints
        self.data.qpos[self.positions] = self.goal_joints
        mujoco.mj_forward(self.model, self.data)
        if watch:
            watch(self.model, self.data)

    def cans(self) -> Float[np.ndarray, "3 2"]:
        """Where the cans are; `ABSENT` those that are not."""
        places = [self.data.xpos[self.bodies[can]][:2] if can in self.bodies else (ABSENT, ABSENT) for can in range(CANS)]
        return np.array(places)

    def push(self, can: int, ahead: Float[np.ndarray, "2"]) -> tuple[str, float]:
        """The event and the tracking error of one push, see `Push`; the simulation stops at the event."""
        if can not in self.bodies or not self._room(can, ahead):
            return "", 0.0
        plan = self.planner.push(self.cans()[can], ahead)
        tracking = 0.0
        for step in range(len(plan.joints)):
            self._follow(plan, step)
            if plan.stroke[0] <= step < plan.stroke[1]:
                tracking = max(tracking, float(np.linalg.norm(self.data.site_xpos[self.tip] - plan.points[step])))
            if event := self._event(can):
                return event, tracking
        return self._settle(can), tracking

    def wait(self, seconds: float) -> None:
        """The arm stands still."""
        for _ in range(round(seconds / self.model.opt.timestep)):
            self._advance(self.goal_joints, np.zeros(JOINTS), np.zeros(JOINTS))

    def _settle(self, can: int) -> str:
        free = self.model.joint(f"can{can}").dofadr[0]
        for _ in range(round(REST_SECONDS / self.model.opt.timestep)):
            if np.abs(self.data.qvel[free : free + 6]).max() < REST:
                break
            self._advance(self.goal_joints, np.zeros(JOINTS), np.zeros(JOINTS))
            if event := self._event(can):
                return event
        return ""

    def _follow(self, plan: Plan, step: int) -> None:
        self.goal_joints = plan.joints[step]
        self._advance(plan.joints[step], plan.speeds[step], plan.accelerations[step])

    def _advance(self, joints: Joints, speeds: Joints, accelerations: Joints) -> None:
        """One time step: the torque that gives the joints the wanted accelerations, and takes back what they are off."""
        model, data = self.model, self.data
        mujoco.mj_step1(model, data)
        off, speed_off = joints - data.qpos[self.positions], speeds - data.qvel[self.dofs]
        motion, torque = np.zeros(model.nv), np.empty(model.nv)
        motion[self.dofs] = wanted(off, speed_off, accelerations, RATE)
        mujoco.mj_mulM(model, data, torque, motion)
        data.ctrl[self.motors] = (torque + data.qfrc_bias)[self.dofs]
        mujoco.mj_step2(model, data)
        if self.watch:
            self.watch(model, data)

    def _event(self, can: int) -> str:
        body, geom = self.bodies[can], self.geoms[can]
        if self.data.xpos[body][2] < CAN_HEIGHT / 2 - SUNK or self.data.xmat[body][8] < FALL_COSINE:
            return "fell"
        touching = self.data.contact.geom[self.data.contact.dist <= 0]
        met = set(touching[(touching == geom).any(axis=1)].ravel().tolist())
        return "hit" if met & (self.fatal - {geom}) else ""

    def _room(self, can: int, ahead: Float[np.ndarray, "2"]) -> bool:
        """Whether the tool finds room behind a can, as the task space asks."""
        cans = self.cans()
        behind = cans[can] + TOOL_START * ahead
        others = [float(np.linalg.norm(cans[other] - behind)) - CAN_RADIUS for other in range(CANS) if other != can]
        walls = float(jnp.min(distances(self.task.obstacles, jnp.asarray(behind, jnp.float32))))
        return min(walls, *others) > TOOL_RADIUS
