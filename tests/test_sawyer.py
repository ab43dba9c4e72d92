"""The Sawyer arm: its geometry, what it does with the cans, and its films."""

from __future__ import annotations

import ctypes.util
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image

import envs
from envs.manipulation.sawyer import camera, motion, replay, stage
from envs.manipulation.sawyer.arm import BASE, FLANGE, LINKS, STICK
from envs.manipulation.sawyer.kinematics import REST, Kinematics, arm_model, limits
from envs.manipulation.table import DIRECTIONS, landscape
from envs.manipulation.targets import DEMONSTRATIONS
from experiments import evaluate, film
from experiments.errors import UsageError
from tests.tables import AWAY, BLUE, GREEN, LEFT, NEAR, RIGHT, push_all, table
from tests.test_manipulation_physics import random_cases

PUSHES = 50


def flange_by_hand(joints):
    """Place and rotation of the flange relative to the base: the links' frames one after the other, as a URDF means them."""
    place, turn = np.zeros(3), np.eye(3)
    for link, angle in zip(LINKS, joints, strict=True):
        place = place + turn @ np.array(link.pos)
        roll, pitch, yaw = link.rpy
        turn = turn @ about(2, yaw) @ about(1, pitch) @ about(0, roll) @ about(2, angle)
    return place + turn @ np.array([0, 0, FLANGE]), turn


def about(axis, angle):
    """The rotation about a coordinate axis."""
    turn = np.eye(3)
    first, second = [(1, 2), (2, 0), (0, 1)][axis]
    turn[[first, second], [first, second]] = np.cos(angle)
    turn[second, first], turn[first, second] = np.sin(angle), -np.sin(angle)
    return turn


class TestKinematics:
    def test_the_arm_stretched_out_is_as_long_as_its_parts(self):
        place, turn = flange_by_hand(np.zeros(7))
        ahead = 0.081 + 0.14 + 0.26 + 0.125 + 0.275 + 0.11 + FLANGE
        left = 0.05 + 0.1425 - 0.042 - 0.1265 + 0.031 + 0.1053
        np.testing.assert_allclose(place, [ahead, left, 0.08 + 0.237], atol=1e-4)
        np.testing.assert_allclose(turn[:, 2], [1, 0, 0], atol=1e-4)

    def test_mujoco_places_the_tip_where_the_frames_say(self):
        kinematics, rng = Kinematics(), np.random.default_rng(0)
        for joints in rng.uniform(*limits().T, (50, 7)):
            point, turned = kinematics.pose(joints)
            place, turn = flange_by_hand(joints)
            tip = about(2, np.pi / 2) @ (place + turn @ np.array([0.009, 0, STICK])) + np.array([*BASE, 0])
            np.testing.assert_allclose(point, tip, atol=1e-6)
            np.testing.assert_allclose(turned, about(2, np.pi / 2) @ turn, atol=1e-6)

    def test_the_robot_weighs_what_its_links_do(self):
        model = arm_model()
        moved = sum(model.body(f"right_l{index}").mass[0] for index in range(7))
        np.testing.assert_allclose(moved, sum(link.mass for link in LINKS))
        for index, link in enumerate(LINKS):
            xx, yy, zz, *_ = link.inertia
            np.testing.assert_allclose(model.body(f"right_l{index}").inertia.sum(), xx + yy + zz, rtol=1e-6)

    def test_it_finds_back_to_poses_it_can_take(self):
        kinematics, rng = Kinematics(), np.random.default_rng(1)
        for joints in REST + rng.uniform(-0.3, 0.3, (20, 7)):
            point, turned = kinematics.pose(joints)
            found = kinematics.approach(REST, point, turned, iterations=300)
            at, as_turned = kinematics.pose(found)
            assert np.linalg.norm(at - point) < 1e-5
            assert np.abs(as_turned - turned).max() < 1e-5

    def test_out_of_reach_the_joints_stay_within_their_limits(self):
        kinematics = Kinematics()
        found = kinematics.approach(REST, np.array([5.0, 5.0, 3.0]), np.eye(3), iterations=200)
        lower, upper = limits().T
        assert ((found >= lower) & (found <= upper)).all()

    def test_every_place_of_the_table_is_in_reach(self):
        kinematics = Kinematics()
        for x, y in itertools.product(np.linspace(0.01, 0.89, 7), np.linspace(0.01, 0.59, 5)):
            for ahead in DIRECTIONS:
                planner = motion.Planner(table((45, 30)))
                plan = planner.push(np.array([x, y]), ahead.astype(float))
                raise NotImplementedError(plan, kinematics)


