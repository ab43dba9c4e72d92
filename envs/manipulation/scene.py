"""What a push is simulated with: one can and one tool in the frame of the push, for MuJoCo and for MJX.

The push goes along +x and the can starts at the origin, so that one model serves every action of every task.  Only the
pushed can ever moves: an episode ends as soon as it meets anything else.

MJX has no contacts of cylinders with boxes, and contacts with friction hop at the time step that a cheap push needs: a sliding
contact's friction lifts the can.  Hence two replacements, which `table_scene` does without:

* The can stands on small spheres, which meet one infinite floor; where there is no ground under a sphere its contact is
  switched off.
* Contacts have no friction.  The friction of the can's base is that of the joints which carry the base along x and y.  It acts
  along each axis by itself, and off the ground as well: there a can's end is already decided.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from envs.manipulation.table import CAN_HEIGHT, CAN_RADIUS

TIMESTEP = 0.005
"""Seconds."""

MASS, FRICTION, GRAVITY = 0.35, 0.4, 9.81
"""Kilograms of a can, its coefficient of sliding friction on the table, and m/s^2."""

TOOL_HALF = (0.006, 0.015, 0.02)
TOOL_HEIGHT = 0.035
"""Half sizes of the tool's flat tip, and the height of its centre."""

FOOT_RADIUS = 0.004

CONTACT = "0.01 1"
"""`solref` of all contacts and of the friction: time constant in seconds, damping ratio."""

SOLVER = 'solver="Newton" iterations="1" ls_iterations="4"'


class Model(NamedTuple):
    """The scene of a push, as MJX has it; leaves are numpy arrays.

    Attributes:
      step: `step(model, data) -> data`, jitted: one time step.
      model: the `mjx.Model`.
      data: an `mjx.Data` to replace fields of.
      feet: the spheres' centres relative to that of the can's base, in the order of their contact pairs.
      pairs: contact pairs; those of the feet come first.
    """

    step: Any
    model: Any
    data: Any
    feet: Float[np.ndarray, "feet 3"]
    pairs: int


def feet() -> Float[np.ndarray, "feet 3"]:
    """Centres of the can's feet relative to that of its base: four close to its axis, four on the rim, two between ahead.

    The four inside stand for the centre: a can whose centre has ground about it stands firm.  The four on the rim lie on
    the axes of the push, so that what tips a can over an edge is as far from its centre as the rim.  The two ahead hold a
    can that brakes with its front over an edge, or one whose axis is just beside a corner.
    """
    rim = CAN_RADIUS - FOOT_RADIUS
    axes = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    places = [(0.3 * x, 0.3 * y) for x, y in axes] + axes + [(0.65, 0.65), (0.65, -0.65)]
    return np.array([(rim * x, rim * y, FOOT_RADIUS) for x, y in places])


def can_inertia(height: float) -> str:
    """MJCF of the mass of a solid cylinder whose centre is at `height` in its body's frame."""
    across = MASS * (3 * CAN_RADIUS**2 + CAN_HEIGHT**2) / 12
    return f'<inertial pos="0 0 {height}" mass="{MASS}" diaginertia="{across} {across} {MASS * CAN_RADIUS**2 / 2}"/>'


def tool(**attributes: str) -> str:
    """MJCF of the tool: too heavy for a can to slow it down; its motion is prescribed."""
    extra = " ".join(f'{name}="{value}"' for name, value in attributes.items())
    return f"""
    <body name="tool" pos="0 0 {TOOL_HEIGHT}">
      <joint name="tool" type="slide" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="200" diaginertia="1 1 1"/>
      <geom name="tool" type="box" size="{numbers(TOOL_HALF)}" {extra}/>
    </body>"""


def push_xml(*, with_tool: bool = True) -> str:
    """MJCF of the scene.  The can's side meets nothing but the tool, so it may reach beyond top and bottom."""
    silent = {"contype": "0", "conaffinity": "0"}
    off = " ".join(f'{name}="{value}"' for name, value in silent.items())
    spheres = [
        f'<geom name="foot{i}" type="sphere" size="{FOOT_RADIUS}" pos="{numbers(place)}" {off}/>'
        for i, place in enumerate(feet())
    ]
    pairs = [f'<pair geom1="floor" geom2="foot{i}" condim="1" solref="{CONTACT}"/>' for i in range(len(spheres))]
    pairs += [f'<pair geom1="tool" geom2="side" condim="1" solref="{CONTACT}"/>'] if with_tool else []
    sliding = f'type="slide" frictionloss="{FRICTION * MASS * GRAVITY}" solreffriction="{CONTACT}"'
    return f"""
<mujoco model="push">
  <option timestep="{TIMESTEP}" gravity="0 0 {-GRAVITY}" {SOLVER} jacobian="dense">
    <flag eulerdamp="disable"/>
  </option>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" {off}/>
    <body name="can">
      <joint name="x" axis="1 0 0" {sliding}/>
      <joint name="y" axis="0 1 0" {sliding}/>
      <joint name="z" axis="0 0 1" type="slide"/>
      <joint name="lean" type="ball"/>
      {can_inertia(CAN_HEIGHT / 2)}
      <geom name="side" type="capsule" size="{CAN_RADIUS} {CAN_HEIGHT / 2}" pos="0 0 {CAN_HEIGHT / 2}" {off}/>
      {"".join(spheres)}
    </body>
    {tool(**silent) if with_tool else ""}
  </worldbody>
  <contact>{"".join(pairs)}</contact>
</mujoco>"""


def check_drawing() -> None:
    """Checks that MuJoCo can be imported, which it cannot if `MUJOCO_GL` names a library that is missing.

    Raises:
      ValueError: what to install, or to unset.
    """
    named = os.environ.get("MUJOCO_GL")
    if named not in ("egl", "osmesa"):
        return
    try:
        import mujoco  # noqa: F401
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"MUJOCO_GL={named} names a library that does not load ({error}): install it (Debian and Ubuntu: libegl1 "
            "libopengl0, or libosmesa6) or unset MUJOCO_GL; only drawing the robot needs one"
        ) from error


@functools.cache
def push_model() -> Model:
    """The scene for MJX; made once, at first use."""
    import mujoco

    return for_mjx(mujoco.MjModel.from_xml_string(push_xml()), lambda mjx: mjx.step)


def for_mjx(model: Any, step: Callable[[Any], Callable[..., Any]]) -> Model:
    """A scene made for MJX; not at import, because importing MJX takes seconds and prints.

    Args:
      model: the `MjModel`.
      step: takes the module `mjx` to what is to become `Model.step`.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx

    with jax.ensure_compile_time_eval(), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        put = mjx.put_model(model, impl="jax")
        put, data = jax.tree.map(np.asarray, (put, mjx.make_data(put)))
    # Jitted, because tracing it takes seconds: so it is traced once, however many programs push cans.
    return Model(jax.jit(step(mjx)), put, data, feet(), model.npair)


def numbers(values: Iterable[float]) -> str:
    """As an attribute of MuJoCo's XML has them."""
    return " ".join(f"{value:.9g}" for value in values)
