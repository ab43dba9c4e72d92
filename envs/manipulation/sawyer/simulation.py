"""The arm of a push in MJX: the seven joints that hold the tool, moved by their motors against a can.

The scene is that of the tool alone, with the arm in its place.  Its base stands where it is as seen from the can, which differs
from push to push but is data of the one model.
"""

from __future__ import annotations

import functools
from typing import Any

import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from envs.manipulation.push import Drive, Motion, Supported, at_rest, take_step
from envs.manipulation.sawyer.arm import BASE, RIGHT_ANGLE, arm_xml
from envs.manipulation.sawyer.course import STROKE_STEPS, course
from envs.manipulation.sawyer.kinematics import JOINTS
from envs.manipulation.sawyer.servo import wanted
from envs.manipulation.sawyer.stage import PREFIX, mirror_places
from envs.manipulation.sawyer.unfused import unfused
from envs.manipulation.scene import CONTACT, TIMESTEP, Model, for_mjx, push_xml

RATE = 0.5 / TIMESTEP
"""How fast the joints come back to their course (1/s, see `servo`), about as fast as the time step allows: the hand is light,
and nothing but the motors holds it as it meets the can, which throws it back by 4 mm; at 0.3 per time step it were 9 mm."""


def sawyer(place: Float[Array, "2"], ahead: Float[Array, "2"]) -> Drive:
    """The Sawyer: computed-torque control within the motors' limits on the course of `course`, then it stands still.

    See `envs.manipulation.push.Arm`; each push starts at rest behind the can.
    """
    seen, seen_ahead = mirror_places(place), jnp.stack([-ahead[0], ahead[1]])
    joints = course(seen, seen_ahead)
    joints = jnp.concatenate([joints, joints[-1:]])  # where it stands still
    speeds = jnp.diff(joints, axis=0, prepend=joints[:1], append=joints[-1:]) / TIMESTEP
    accelerations = jnp.diff(speeds, axis=0) / TIMESTEP
    scene = standing(arm_scene(), seen, seen_ahead)

    def advance(motion: Motion, supported: Supported) -> Motion:
        now = jnp.minimum(motion.steps, STROKE_STEPS + 1)
        off, speed_off = joints[now] - motion.qpos[-JOINTS:], speeds[now] - motion.qvel[-JOINTS:]
        data = scene.data.replace(ctrl=wanted(off, speed_off, accelerations[now], RATE))
        return take_step(scene._replace(data=data), motion, supported)

    # The table as the robot sees it is the mirror image of the task's.
    return Drive(at_rest(joints[0]), -1, advance)


@functools.cache
def arm_scene() -> Model:
    """The scene for MJX, whose `ctrl` are the accelerations wanted of the joints; made once, at first use."""
    return for_mjx(push_scene(), lambda mjx: unfused(functools.partial(_step, mjx)))


@functools.cache
def push_scene() -> mujoco.MjModel:
    """The scene: can, floor and the arm, of whose geoms only the tool's tip is there."""
    arm = mujoco.MjSpec.from_string(arm_xml())
    for geom in [geom for geom in arm.geoms if geom.name != "tip"]:
        arm.delete(geom)
    scene = mujoco.MjSpec.from_string(push_xml(with_tool=False))
    scene.attach(arm, prefix=PREFIX, frame=scene.worldbody.add_frame())
    scene.add_pair(geomname1=f"{PREFIX}tip", geomname2="side", condim=1, solref=[float(x) for x in CONTACT.split()])
    return scene.compile()


def _step(mjx: Any, model: Any, data: Any) -> Any:
    """MJX's own time step, with what the motors do decided half way: as soon as masses and bias forces are known."""
    accelerations = jnp.concatenate([jnp.zeros(model.nv - JOINTS), data.ctrl])
    data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
    torques = mjx.mul_m(model, data, accelerations) + data.qfrc_bias
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data.replace(ctrl=torques[-JOINTS:])))
    return mjx.euler(model, mjx.solve(model, data))


def standing(scene: Model, place: Float[Array, "2"], ahead: Float[Array, "2"]) -> Model:
    """The scene with the base where it is seen from a can at `place` that is pushed in the direction `ahead`.

    Args:
      place, ahead: as the robot sees them, in metres and a unit vector along x or y.
    """
    index = push_scene().body(f"{PREFIX}base").id
    x, y = jnp.asarray(BASE, jnp.float32) - place
    zero = jnp.zeros(())
    point = jnp.stack([x * ahead[0] + y * ahead[1], y * ahead[0] - x * ahead[1], zero])
    half = (RIGHT_ANGLE - jnp.atan2(ahead[1], ahead[0])) / 2
    turn = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])
    places, turns = jnp.asarray(scene.model.body_pos), jnp.asarray(scene.model.body_quat)
    return scene._replace(model=scene.model.replace(body_pos=places.at[index].set(point), body_quat=turns.at[index].set(turn)))
