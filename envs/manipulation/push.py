"""One push of a can on a table, simulated until the can rests (for `STEPS` at most) or the first event.

An event is a fall (off the table or into a hole) or a hit (of an obstacle or another can).  The physics knows the can, the
tool and the ground; whether the can meets anything else is geometry.  The pose is frozen at the first event.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from envs.manipulation.scene import FOOT_RADIUS, TIMESTEP, TOOL_HALF, Model, push_model
from envs.manipulation.table import CAN_RADIUS, CANS, DIRECTIONS, FAR, Task, distances, on_ground

STROKE = 0.10
"""Metres that the tool goes on once it touches the can."""

GAP = 0.003
"""Metres from the tool to the can before the push."""

STROKE_SECONDS = 0.3
STEPS = 72
"""Duration of the tool's motion, and simulation steps of a push at most: a can that leaves the tool slides on for a moment."""

TOOL_START = -(CAN_RADIUS + GAP + TOOL_HALF[0])
TOOL_RADIUS = 0.015
"""Where the tool's centre starts from, seen from the can, and its size where it must find room."""

STEP, SUNK = 0.012, 0.02
FALL_COSINE = 0.94
"""A foot this far below the surface finds no ground; a can this far below it, or tilted by 20 degrees, is falling."""

REST_SPEED = 0.005


class Outcome(NamedTuple):
    """What a push did.

    Attributes:
      position: (x, y) of the pushed can, at rest or at the first event.
      fell: it falls.
      hit: it met an obstacle or another can; never together with `fell`.
    """

    position: Float[Array, "2"]
    fell: Bool[Array, ""]
    hit: Bool[Array, ""]


class Motion(NamedTuple):
    """The simulation's state: MuJoCo's generalised positions, velocities and accelerations, time steps, and events so far.

    The first seven positions are the can's (x, y, z) and quaternion, the others those of the joints of what holds the tool.
    """

    qpos: Float[Array, "nq"]
    qvel: Float[Array, "nq-1"]
    qacc: Float[Array, "nq-1"]
    steps: Int[Array, ""]
    fell: Bool[Array, ""]
    hit: Bool[Array, ""]


Supported = Callable[[Float[Array, "feet 3"]], Bool[Array, "feet"]]
"""Says which of the can's feet, given by their centres in the frame of the push, have ground under them."""


class Drive(NamedTuple):
    """What carries out one push.

    Attributes:
      start: the can upright at the origin of the push's frame, the tool behind it.
      side: -1 if that frame's y axis points to the right of the push on the table, 1 if to the left.
      advance: `advance(motion, supported)`: one time step.
    """

    start: Motion
    side: int
    advance: Callable[[Motion, Supported], Motion]


Arm = Callable[[Float[Array, "2"], Float[Array, "2"]], Drive]
"""`arm(place, ahead)`: how it pushes a can at a place on the table, in metres, in a direction, a unit vector along x or y."""


def tool(place: Float[Array, "2"], ahead: Float[Array, "2"]) -> Drive:
    """No arm: the tool slides along its stroke by itself, everywhere alike."""
    del place, ahead
    return Drive(at_rest(), 1, simulate)


def push(
    task: Task,
    cans: Float[Array, "3 2"],
    present: Bool[Array, "3"],
    *,
    can: Int[Array, ""],
    direction: Int[Array, ""],
    arm: Arm = tool,
) -> Outcome:
    """Pushes one can while the others stand still; nothing moves unless `possible`."""
    start = cans[can]
    ahead = jnp.asarray(DIRECTIONS)[direction]
    others = present & (jnp.arange(CANS) != can)
    carried_out = possible(task, cans, present, can=can, direction=direction)
    drive = arm(start, ahead)

    def to_table(points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        turned = drive.side * jnp.stack([-ahead[1], ahead[0]])
        return start[None] + points[:, :1] * ahead[None] + points[:, 1:] * turned[None]

    def supported(feet: Float[Array, "feet 3"]) -> Bool[Array, "feet"]:
        return on_ground(task.ground, to_table(feet[:, :2])) & (feet[:, 2] > FOOT_RADIUS - STEP)

    def going(motion: Motion) -> Bool[Array, ""]:
        over = (motion.steps >= STEPS) | motion.fell | motion.hit
        slow = jnp.max(jnp.abs(motion.qvel[:6])) < REST_SPEED
        return carried_out & ~over & ~((motion.steps > round(STROKE_SECONDS / TIMESTEP)) & slow)

    def advance(motion: Motion) -> Motion:
        moved = drive.advance(motion, supported)
        # A simulation that has come apart is a fall from where it still held together, and its NaN goes no further.
        sound = jnp.all(jnp.isfinite(moved.qpos)) & jnp.all(jnp.isfinite(moved.qvel))
        moved = jax.tree.map(lambda new, old: jnp.where(sound, new, old), moved, motion)
        x, y, z = moved.qpos[:3]
        fell = ~sound | (z < -SUNK) | (tilt_cosine(moved.qpos) < FALL_COSINE)
        hit = clearance(task, cans, others, to_table(jnp.stack([x, y])[None])[0]) < CAN_RADIUS
        return moved._replace(fell=fell, hit=hit & ~fell)

    end = jax.lax.while_loop(going, advance, drive.start)
    position = to_table(end.qpos[None, :2])[0]
    return Outcome(jnp.where(carried_out, position, start), end.fell, end.hit)


def possible(
    task: Task, cans: Float[Array, "3 2"], present: Bool[Array, "3"], *, can: Int[Array, ""], direction: Int[Array, ""]
) -> Bool[Array, ""]:
    """Whether a can is there and the tool finds room behind it."""
    behind = cans[can] + TOOL_START * jnp.asarray(DIRECTIONS)[direction]
    return present[can] & (clearance(task, cans, present & (jnp.arange(CANS) != can), behind) > TOOL_RADIUS)


def clearance(task: Task, cans: Float[Array, "3 2"], those: Bool[Array, "3"], point: Float[Array, "2"]) -> Float[Array, ""]:
    """Metres from a point to the nearest obstacle or one of `those` cans."""
    to_cans = jnp.where(those, jnp.sqrt(jnp.sum((cans - point[None]) ** 2, axis=-1)) - CAN_RADIUS, FAR)
    return jnp.minimum(jnp.min(to_cans), jnp.min(distances(task.obstacles, point)))


def at_rest(joints: ArrayLike = (TOOL_START,)) -> Motion:
    """The can upright at the origin, and what holds the tool; by default no arm, and the tool behind the can."""
    upright = np.array([0, 0, 0, 1, 0, 0, 0], np.float32)
    qpos = jnp.concatenate([jnp.asarray(upright), jnp.asarray(joints, jnp.float32)])
    zeros, no = jnp.zeros(len(qpos) - 1), jnp.zeros((), bool)
    return Motion(qpos, zeros, zeros, jnp.int32(0), no, no)


def simulate(motion: Motion, supported: Supported) -> Motion:
    """One time step of MJX with the tool where it has to be."""
    place, speed = stroke(motion.steps.astype(jnp.float32) * TIMESTEP)
    held = motion._replace(qpos=motion.qpos.at[7].set(TOOL_START + place), qvel=motion.qvel.at[6].set(speed))
    return take_step(push_model(), held, supported)


def take_step(scene: Model, motion: Motion, supported: Supported) -> Motion:
    """One time step of a scene in MJX.

    Args:
      scene: whose first contact pairs are those of the feet.
      motion: at the step's start.
    """
    model, data = jax.tree.map(jnp.asarray, (scene.model, scene.data))
    feet = motion.qpos[None, :3] + jnp.asarray(scene.feet, jnp.float32) @ rotation(motion.qpos[3:7]).T
    margin = jnp.concatenate([jnp.where(supported(feet), 0.0, -FAR), jnp.zeros(scene.pairs - len(scene.feet))])
    data = data.replace(qpos=motion.qpos, qvel=motion.qvel, qacc_warmstart=motion.qacc)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # MJX mixes both
        after = scene.step(model.replace(pair_margin=margin), data)
    return motion._replace(qpos=after.qpos, qvel=after.qvel, qacc=after.qacc, steps=motion.steps + 1)


def stroke(time: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Metres that the tool has gone at a time in seconds, and its speed: half a period of a cosine."""
    phase = jnp.pi * jnp.clip(time / STROKE_SECONDS, 0.0, 1.0)
    half = (STROKE + GAP) / 2
    return half * (1 - jnp.cos(phase)), half * jnp.pi / STROKE_SECONDS * jnp.sin(phase)


def tilt_cosine(qpos: Float[Array, "nq"]) -> Float[Array, ""]:
    """Cosine of the angle between the can's axis and the vertical."""
    return 1 - 2 * (qpos[4] ** 2 + qpos[5] ** 2)


def rotation(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """The rotation matrix of a unit quaternion."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
