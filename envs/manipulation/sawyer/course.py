"""The joints' course for the stroke of a push, in JAX: the inverse kinematics of `kinematics`, always as many iterations."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from envs.manipulation.push import STROKE_SECONDS, stroke
from envs.manipulation.sawyer.kinematics import JOINTS, REST, arm_model, closer
from envs.manipulation.sawyer.pose import behind, rotation
from envs.manipulation.scene import TIMESTEP

APPROACH, SETTLE = 20, 10
"""Iterations on a straight way from the tip's place at `REST` to where a push starts, and at its end."""

FOLLOW = 2
"""Iterations for a time step of the stroke."""

STROKE_STEPS = round(STROKE_SECONDS / TIMESTEP)


class Frames(NamedTuple):
    """Where each link is in the one before, with its joint at zero, the first in the world; and the tip in the last.

    Attributes:
      places, turns: of the links, in metres and as rotation matrices.
      tip, tip_turn: of the tip.
    """

    places: Float[np.ndarray, "7 3"]
    turns: Float[np.ndarray, "7 3 3"]
    tip: Float[np.ndarray, "3"]
    tip_turn: Float[np.ndarray, "3 3"]


@functools.cache
def frames() -> Frames:
    """Those of the robot's model, in float32."""
    model = arm_model()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    links = [data.body(f"right_l{index}") for index in range(JOINTS)]
    places, turns = np.array([link.xpos for link in links]), np.array([link.xmat.reshape(3, 3) for link in links])
    tip, tip_turn = data.site("tip").xpos, data.site("tip").xmat.reshape(3, 3)
    before = np.concatenate([np.eye(3)[None], turns[:-1]])
    steps = np.diff(places, axis=0, prepend=np.zeros((1, 3)))
    found = (
        np.einsum("nji,nj->ni", before, steps),
        np.einsum("nji,njk->nik", before, turns),
        turns[-1].T @ (tip - places[-1]),
        turns[-1].T @ tip_turn,
    )
    return Frames(*(part.astype(np.float32) for part in found))


def course(place: Float[Array, "2"], ahead: Float[Array, "2"]) -> Float[Array, "61 7"]:
    """Joint angles in radians, one row per time step of `scene` from the start of a stroke to its end.

    Within half a millimetre of the tip's, and within the joints' limits of position.  The stroke's time is the task space's:
    where the arm is stretched out, joints turn faster than the real ones can.

    Args:
      place: (x, y) of the can in metres, as the robot sees it.
      ahead: direction of the push, a unit vector along x or y, as the robot sees it.
    """
    start = behind(place, ahead)
    rest = jnp.asarray(REST, jnp.float32)
    # The last joint turns the tool about its stick: from where its heading is right.
    _, turned, _ = tip(rest)
    heading = jnp.atan2(turned[1, 0], turned[0, 0])
    seed = rest.at[-1].add(heading - start[3])
    shares = jnp.minimum(jnp.arange(1, APPROACH + SETTLE + 1) / APPROACH, 1.0)
    first = tip(seed)[0]
    goal = rotation(start)

    def come(joints: Float[Array, "7"], share: Float[Array, ""]) -> tuple[Float[Array, "7"], None]:
        return approach(joints, first + share * (start[:3] - first), goal), None

    def go(joints: Float[Array, "7"], gone: Float[Array, ""]) -> tuple[Float[Array, "7"], Float[Array, "7"]]:
        for _ in range(FOLLOW):
            joints = approach(joints, start[:3] + gone * jnp.concatenate([ahead, jnp.zeros(1)]), goal)
        return joints, joints

    begin, _ = jax.lax.scan(come, seed, shares)
    times = TIMESTEP * jnp.arange(1, STROKE_STEPS + 1, dtype=jnp.float32)
    _, rows = jax.lax.scan(go, begin, jax.vmap(stroke)(times)[0])
    return jnp.concatenate([begin[None], rows])


def approach(joints: Float[Array, "7"], point: Float[Array, "3"], rotation: Float[Array, "3 3"]) -> Float[Array, "7"]:
    """Joint angles one iteration closer to a pose of the tip, see `closer`; less than half a turn away."""
    at, turned, jacobian = tip(joints)
    turn = rotation @ turned.T
    twice = jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = jnp.sqrt(jnp.sum(twice**2)) / 2
    angle = jnp.atan2(sine, (jnp.trace(turn) - 1) / 2)
    scale = jnp.where(sine < 1e-6, 0.5, angle / jnp.where(sine < 1e-6, 1.0, 2 * sine))
    return closer(joints, jnp.concatenate([point - at, scale * twice]), jacobian)


def tip(joints: Float[Array, "7"]) -> tuple[Float[Array, "3"], Float[Array, "3 3"], Float[Array, "6 7"]]:
    """Place of the tip in metres, the rotation that takes its axes to the world's, and by joint how it moves and turns."""
    known = frames()

    def follow(
        frame: tuple[Float[Array, "3"], Float[Array, "3 3"]], link: tuple[Array, Array, Array]
    ) -> tuple[tuple[Float[Array, "3"], Float[Array, "3 3"]], tuple[Float[Array, "3"], Float[Array, "3"]]]:
        (place, turn), (step, fixed, angle) = frame, link
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        joint = jnp.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        after = place + turn @ step, turn @ fixed @ joint
        return after, (after[0], after[1][:, 2])

    links = jnp.asarray(known.places), jnp.asarray(known.turns), joints
    (place, turn), (places, axes) = jax.lax.scan(follow, (jnp.zeros(3), jnp.eye(3)), links)
    point = place + turn @ known.tip
    moves = jnp.cross(axes, point[None] - places)
    return point, turn @ known.tip_turn, jnp.concatenate([moves.T, axes.T])
