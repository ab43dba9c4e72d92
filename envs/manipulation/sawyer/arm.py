"""The Sawyer arm: links, joints and motors of the real robot, drawn from cylinders, with a stick-like tool at its flange.

Frames, masses, inertias and limits of position, speed and torque are the manufacturer's, from
`sawyer_description/urdf/sawyer_base.urdf.xacro` of Rethink Robotics' `sawyer_robot` (Apache-2.0).  The joints have no friction
and the motors no inertia of their own: that file gives none that is measured (damping and friction 5 for every joint alike).

A link reaches from its joint's axis to the next one's, so the housings follow from the frames; their radii are about those of
the same file's collision shapes.
"""

from __future__ import annotations

from typing import NamedTuple

from envs.manipulation.scene import TOOL_HALF, numbers
from envs.manipulation.table import BLOCK, COLUMNS

Vector = tuple[float, float, float]

BASE = (COLUMNS * BLOCK / 2, -0.27)
"""(x, y) of the robot's axis on the table, as the robot sees it (see `mirror`); its base is as high as the surface."""

HEIGHT = 0.915
"""Metres of the pedestal, from the floor to the base."""

STICK, STICK_RADIUS, BEHIND = 0.3, 0.005, 0.009
"""Metres from the flange to the tool's tip, radius of the stick, and how far its axis is behind the tip's centre, so that only
the tip touches a can, even where the tool leans over it."""

TOOL_MASS = 0.2


class Link(NamedTuple):
    """A link and the joint about its z axis that carries it.

    Attributes:
      pos, rpy: its frame in that of the link before, in metres and radians (roll, pitch and yaw about fixed axes).
      mass, center: in kilograms, and metres in its own frame.
      inertia: xx, yy, zz, xy, xz and yz about the centre of mass, in kg m^2.
      limits: of the joint, in radians.
      speed, torque: of the joint at most, in rad/s and N m.
      housings: cylinders from one point to another, with a radius.
    """

    pos: Vector
    rpy: Vector
    mass: float
    center: Vector
    inertia: tuple[float, float, float, float, float, float]
    limits: tuple[float, float]
    speed: float
    torque: float
    housings: tuple[tuple[Vector, Vector, float], ...]


RIGHT_ANGLE = 1.57079632679

LINKS = (
    Link(
        pos=(0, 0, 0.08),
        rpy=(0, 0, 0),
        mass=5.3213,
        center=(0.024366, 0.010969, 0.14363),
        inertia=(0.053314, 0.057902, 0.023659, 0.0047093, 0.011734, 0.0080179),
        limits=(-3.0503, 3.0503),
        speed=1.74,
        torque=80,
        housings=(((0, 0, 0), (0, 0, 0.28), 0.075), ((0, 0, 0.237), (0.081, 0, 0.237), 0.065)),
    ),
    Link(
        pos=(0.081, 0.05, 0.237),
        rpy=(-RIGHT_ANGLE, RIGHT_ANGLE, 0),
        mass=4.505,
        center=(-0.0030849, -0.026811, 0.092521),
        inertia=(0.022398, 0.014613, 0.017295, -0.00023986, -0.00029362, -0.0060875),
        limits=(-3.8095, 2.2736),
        speed=1.328,
        torque=80,
        housings=(((0, 0, -0.05), (0, 0, 0.1425), 0.07), ((0, 0, 0.1425), (0, -0.14, 0.1425), 0.065)),
    ),
    Link(
        pos=(0, -0.14, 0.1425),
        rpy=(RIGHT_ANGLE, 0, 0),
        mass=1.745,
        center=(-0.00016044, -0.014967, 0.13582),
        inertia=(0.025506, 0.0253, 0.0034179, 4.4101e-06, 1.4955e-05, -0.0033204),
        limits=(-3.0426, 3.0426),
        speed=1.957,
        torque=40,
        housings=(((0, 0, 0), (0, 0, 0.26), 0.06),),
    ),
    Link(
        pos=(0, -0.042, 0.26),
        rpy=(-RIGHT_ANGLE, 0, 0),
        mass=2.5097,
        center=(-0.0048135, -0.0281, -0.084154),
        inertia=(0.01016, 0.0065685, 0.0069078, -9.7452e-06, 0.00026624, 0.0030316),
        limits=(-3.0439, 3.0439),
        speed=1.957,
        torque=40,
        housings=(((0, 0, 0.042), (0, 0, -0.1265), 0.055), ((0, 0, -0.1265), (0, -0.125, -0.1265), 0.05)),
    ),
    Link(
        pos=(0, -0.125, -0.1265),
        rpy=(RIGHT_ANGLE, 0, 0),
        mass=1.1136,
        center=(-0.0018844, 0.0069001, 0.1341),
        inertia=(0.013557, 0.013555, 0.0013658, 1.8109e-05, 0.00013523, 0.0010561),
        limits=(-2.9761, 2.9761),
        speed=3.485,
        torque=9,
        housings=(((0, 0, 0), (0, 0, 0.275), 0.045),),
    ),
    Link(
        pos=(0, 0.031, 0.275),
        rpy=(-RIGHT_ANGLE, 0, 0),
        mass=1.5625,
        center=(0.0061133, -0.023697, 0.076416),
        inertia=(0.0047328, 0.0029676, 0.0031762, 0.00011526, 4.6269e-05, -0.0011557),
        limits=(-2.9761, 2.9761),
        speed=3.485,
        torque=9,
        housings=(((0, 0, -0.031), (0, 0, 0.1053), 0.05), ((0, 0, 0.1053), (0, -0.085, 0.1053), 0.045)),
    ),
    Link(
        pos=(0, -0.11, 0.1053),
        rpy=(-RIGHT_ANGLE, -0.17453, 3.1416),
        mass=0.3292,
        center=(-8.0726e-06, 0.0085838, -0.0049566),
        inertia=(0.00031105, 0.00021549, 0.00035976, 1.4771e-06, -3.7074e-07, -8.4533e-06),
        limits=(-4.7124, 4.7124),
        speed=4.545,
        torque=9,
        housings=(((0, 0, -0.025), (0, 0, 0.0245), 0.04),),
    ),
)
"""`right_l0` to `right_l6`, each with the joint `right_j0` to `right_j6` of the same number."""

FLANGE = 0.0245
"""Metres along z from the last link's frame to the flange."""

RED, GREY, BLACK = "0.5 0.1 0.1 1", "0.65 0.65 0.67 1", "0.15 0.15 0.16 1"


def arm_xml() -> str:
    """MJCF of the robot on its pedestal, facing the table, with a motor for each joint; nothing of it meets anything but cans.

    The site `tip` is the centre of the tool's flat tip: its x axis the tip's normal, its z axis from the flange to the tip.
    Of its geoms only `tip` and `stick` are solid.
    """
    body = _tool()
    for index in reversed(range(len(LINKS))):
        body = _link(index, (_head() if index == 0 else "") + body)
    motors = [
        f'<motor name="right_j{index}" joint="right_j{index}" ctrlrange="{-link.torque} {link.torque}"/>'
        for index, link in enumerate(LINKS)
    ]
    return f"""
<mujoco model="sawyer">
  <compiler angle="radian" eulerseq="XYZ" autolimits="true"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="base" pos="{numbers(BASE)} 0" euler="0 0 {RIGHT_ANGLE}">
      <geom type="cylinder" fromto="0 0 0 0 0 0.08" size="0.08" rgba="{BLACK}"/>
      <geom type="cylinder" fromto="0 0 -0.6 0 0 0" size="0.11" rgba="{BLACK}"/>
      <geom type="box" pos="-0.02 0 {(-0.6 - HEIGHT) / 2}" size="0.3 0.3 {(HEIGHT - 0.6) / 2}" rgba="{BLACK}"/>
      {body}
    </body>
  </worldbody>
  <actuator>{"".join(motors)}</actuator>
</mujoco>"""


def _link(index: int, inside: str) -> str:
    link, name = LINKS[index], f"right_l{index}"
    housings = [
        f'<geom name="{name}_{part}" type="capsule" fromto="{numbers((*start, *end))}" size="{radius}" '
        f'rgba="{GREY if part else RED}"/>'
        for part, (start, end, radius) in enumerate(link.housings)
    ]
    return f"""
    <body name="{name}" pos="{numbers(link.pos)}" euler="{numbers(link.rpy)}">
      <inertial pos="{numbers(link.center)}" mass="{link.mass}" fullinertia="{numbers(link.inertia)}"/>
      <joint name="right_j{index}" axis="0 0 1" range="{numbers(link.limits)}"/>
      {"".join(housings)}
      {inside}
    </body>"""


def _head() -> str:
    """The display on the shoulder, looking ahead; the joint that turns it on the real robot stays where it is."""
    inertia = (0.011833, 0.0082709, 0.0049661, -4.4669e-06, 4.9425e-05, 4.2124e-07)
    return f"""
    <body name="head" pos="0 0 0.2965">
      <inertial pos="0.0053207 -2.6549e-05 0.1021" mass="1.5795" fullinertia="{numbers(inertia)}"/>
      <geom type="cylinder" fromto="0 0 0 0 0 0.1" size="0.03" rgba="{GREY}"/>
      <geom type="box" pos="0.015 0 0.105" size="0.014 0.125 0.075" rgba="{GREY}"/>
      <geom type="box" pos="0.03 0 0.105" size="0.001 0.12 0.07" rgba="{BLACK}"/>
    </body>"""


def _tool() -> str:
    tip = FLANGE + STICK
    ends = f"0 0 {FLANGE} 0 0 {tip}"
    solid = 'contype="2" friction="0.2 .005 .0001" solref="0.01 1"'
    return f"""
    <body name="tool">
      <inertial pos="0 0 {FLANGE + STICK / 3}" mass="{TOOL_MASS}" diaginertia="0.002 0.002 0.0001"/>
      <geom type="cylinder" fromto="0 0 {FLANGE} 0 0 {FLANGE + 0.06}" size="0.02" rgba="{BLACK}"/>
      <geom name="stick" type="cylinder" fromto="{ends}" size="{STICK_RADIUS}" rgba="{BLACK}" {solid}/>
      <geom name="tip" type="box" pos="{BEHIND} 0 {tip}" size="{numbers(TOOL_HALF)}" rgba="{BLACK}" {solid}/>
      <site name="tip" pos="{BEHIND} 0 {tip}" size="0.001" group="4"/>
    </body>"""
