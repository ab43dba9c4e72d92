"""The Sawyer arm inside MJX: its course, its scene, and its pushes beside those of the tool alone."""

from __future__ import annotations

import copy
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from apt_jax.config import PRESETS
from apt_jax.trainer import Clock, make_trainer
from envs.manipulation import Space
from envs.manipulation.push import GAP, STROKE, stroke
from envs.manipulation.sawyer import pose, simulation
from envs.manipulation.sawyer.course import STROKE_STEPS, course, tip
from envs.manipulation.sawyer.kinematics import Kinematics, arm_model, limits
from envs.manipulation.sawyer.stage import mirror_places
from envs.manipulation.sawyer.unfused import unfused
from envs.manipulation.scene import TIMESTEP, TOOL_HALF, TOOL_HEIGHT
from envs.manipulation.table import CAN_RADIUS, DIRECTIONS
from experiments import film
from tests.tables import BLUE, GREEN, LEFT, RIGHT, push_all, table
from tests.test_manipulation_physics import random_cases

PUSHES = 28
BATCH = PUSHES + 4


@pytest.fixture(scope="module")
def courses():
    """Places all over the table, directions, and the joints' courses of these pushes."""
    grid = np.stack(np.meshgrid(np.linspace(0.01, 0.89, 5), np.linspace(0.01, 0.59, 4)), axis=-1).reshape(-1, 2)
    places = np.repeat(grid, 4, axis=0).astype(np.float32)
    aheads = np.tile(DIRECTIONS, (len(grid), 1))
    return places, aheads, np.asarray(jax.jit(jax.vmap(course))(places, aheads), float)


class TestCourse:
    def test_the_tip_is_where_mujoco_has_it(self):
        kinematics, rng = Kinematics(), np.random.default_rng(0)
        joints = rng.uniform(*limits().T, (20, 7)).astype(np.float32)
        points, turns, _ = jax.vmap(tip)(joints)
        for each, point, turn in zip(joints, points, turns, strict=True):
            for found, expected in zip((point, turn), kinematics.pose(each.astype(float)), strict=True):
                np.testing.assert_allclose(found, expected, atol=1e-5)

    def test_the_jacobian_is_the_derivative(self):
        joints = jnp.asarray(np.random.default_rng(1).uniform(*limits().T), jnp.float32)
        _, turn, jacobian = tip(joints)
        moves, turns = jax.jacfwd(lambda at: tip(at)[:2])(joints)
        np.testing.assert_allclose(jacobian[:3], moves, atol=1e-5)
        spins = np.einsum("ijk,lj->ilk", turns, turn)
        np.testing.assert_allclose(jacobian[3:], [spins[2, 1], spins[0, 2], spins[1, 0]], atol=1e-5)

    def test_the_tip_keeps_to_the_stroke_all_over_the_table(self, courses):
        kinematics = Kinematics()
        gone = np.asarray(jax.vmap(stroke)(jnp.arange(STROKE_STEPS + 1, dtype=jnp.float32) * TIMESTEP)[0])
        for place, ahead, joints in zip(*courses, strict=True):
            start = pose.behind(place.astype(float), ahead.astype(float))
            for step in range(0, STROKE_STEPS + 1, 20):
                point, turn = kinematics.pose(joints[step])
                np.testing.assert_allclose(point, start[:3] + gone[step] * np.append(ahead, 0), atol=5e-4)
                np.testing.assert_allclose(turn, pose.rotation(start), atol=2e-3)

    def test_joints_keep_well_within_their_limits(self, courses):
        lower, upper = limits().T
        assert (courses[2] > lower + 0.05).all()
        assert (courses[2] < upper - 0.05).all()


class TestScene:
    def test_the_arm_holds_the_tip_behind_the_can(self, courses):
        """In the frame of the push, where the base is elsewhere in each push."""
        scene = simulation.arm_scene()
        for place, ahead, joints in list(zip(*courses, strict=True))[::7]:
            model = copy.copy(simulation.push_scene())
            stands = simulation.standing(scene, jnp.asarray(place), jnp.asarray(ahead)).model
            model.body_pos[:], model.body_quat[:] = stands.body_pos, stands.body_quat
            data = mujoco.MjData(model)
            data.qpos[-7:] = joints[-1]
            mujoco.mj_kinematics(model, data)
            x, y, z = data.geom("sawyer/tip").xpos
            np.testing.assert_allclose([y, z], [0, TOOL_HEIGHT], atol=5e-4)
            assert STROKE - CAN_RADIUS - 2 * TOOL_HALF[0] - GAP < x < STROKE - CAN_RADIUS - TOOL_HALF[0] + GAP

    def test_the_feet_come_first_and_nothing_else_touches(self):
        model, feet = simulation.push_scene(), len(simulation.arm_scene().feet)
        names = [model.geom(geom).name for geom in model.pair_geom2]
        assert names[:feet] == [f"foot{index}" for index in range(feet)]
        assert {model.geom(geom[feet]).name for geom in (model.pair_geom1, model.pair_geom2)} == {"side", "sawyer/tip"}
        meets = (model.geom_contype[:, None] & model.geom_conaffinity[None]) != 0
        assert not meets.any()

    def test_it_is_the_robot_of_the_replay(self):
        """Masses, inertias, limits of position and of torque, link by link."""
        ours, theirs = simulation.push_scene(), arm_model()
        for index in range(7):
            name = f"right_l{index}"
            for field in ("mass", "inertia", "ipos", "iquat", "pos", "quat"):
                np.testing.assert_array_equal(getattr(ours.body(f"sawyer/{name}"), field), getattr(theirs.body(name), field))
        np.testing.assert_array_equal(ours.jnt_range[-7:], theirs.jnt_range)
        np.testing.assert_array_equal(ours.actuator_ctrlrange, theirs.actuator_ctrlrange)
        assert ours.actuator_ctrllimited.all()


def test_barriers_change_no_result():
    def chain(x, angles):
        def turn(x, angle):
            return jnp.concatenate([x[1:], x[:1] * jnp.cos(angle)]), jnp.linalg.norm(x)

        x, norms = jax.lax.scan(turn, x, angles)
        return {"x": jnp.outer(x, x) @ jax.nn.relu(x), "norms": norms}

    args = jnp.arange(3.0), jnp.arange(5.0)
    jax.tree.map(np.testing.assert_array_equal, unfused(chain)(*args), chain(*args))
    traced = jax.jit(unfused(chain)).trace(*args)
    for platform, barred in (("cpu", True), ("cuda", False), ("tpu", False)):
        assert ("optimization_barrier" in traced.lower(lowering_platforms=(platform,)).as_text()) == barred


@functools.cache
def _program():
    space = envs.make("manipulation_sawyer")

    def one(task, action):
        state, _ = space.reset(jax.random.key(0), task)
        return space.step(state, action, task)

    return jax.jit(jax.vmap(one))


def step_all(cases):
    """Step outputs of (task, can, direction) cases, as many as fit the one compiled program."""
    padded = [*cases, *[cases[-1]] * (BATCH - len(cases))]
    tasks, cans, directions = zip(*padded, strict=True)
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *tasks)
    out = jax.device_get(_program()(stacked, np.array([4 * can + to for can, to in zip(cans, directions, strict=True)])))
    return jax.tree.map(lambda leaf: leaf[: len(cases)], out)


class TestPushes:
    @pytest.fixture(scope="class")
    @staticmethod
    def pushed():
        """Cases and step outputs: random ones, then four in which nothing can move."""
        wall = table((35, 22), rows="FFFFFF\nF#FFFF\nFFFFFF\nFFFFFF")
        cans = table((30, 20), (39.5, 20))
        cases = [
            *random_cases(PUSHES, seed=2),
            (wall, BLUE, RIGHT),
            (cans, GREEN, RIGHT),
            (cans, BLUE, LEFT),
            (wall, GREEN, LEFT),
        ]
        return cases, step_all(cases)

    def test_random_pushes_end_as_with_the_tool_alone(self, pushed):
        cases, out = pushed[0][:PUSHES], jax.tree.map(lambda leaf: leaf[:PUSHES], pushed[1])
        tool = push_all(cases)
        ended = out.terminated & ~out.success
        ours = np.select([ended & (out.reward < -0.15), ended], ["fell", "hit"], "")
        theirs = np.select([tool.fell, tool.hit], ["fell", "hit"], "")
        assert min((theirs == event).sum() for event in ("", "fell", "hit")) >= 3
        assert (ours == theirs).mean() >= 0.98
        places = np.array([cans[can] for cans, (_, can, _) in zip(out.state.cans, cases, strict=True)])
        away = np.linalg.norm(places - tool.position, axis=-1)
        assert away[(ours == "") & (theirs == "")].mean() <= 0.003

    def test_only_the_pushed_can_moves_and_all_is_finite(self, pushed):
        cases, out = pushed
        for index, (task, can, _) in enumerate(cases):
            others = [other for other in range(3) if other != can]
            np.testing.assert_array_equal(out.state.cans[index][others], np.asarray(task.cans)[others])
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((out.state.cans, out.obs, out.reward)))

    def test_nothing_moves_without_a_can_or_room_for_the_tool(self, pushed):
        cases, out = pushed
        for index in range(PUSHES, BATCH):
            np.testing.assert_array_equal(out.state.cans[index], cases[index][0].cans)
        assert not out.terminated[PUSHES:].any()

    def test_an_outcome_does_not_depend_on_what_is_pushed_beside_it(self, pushed):
        cases, out = pushed
        for index in (0, 1):
            (alone,) = step_all([cases[index]]).state.cans
            np.testing.assert_allclose(alone, out.state.cans[index], atol=1e-5)


class TestOption:
    def test_a_space_by_the_arms_name(self):
        space = envs.make("manipulation_sawyer")
        assert (space.name, space.arm) == ("manipulation_sawyer", "sawyer")
        assert (Space().name, Space().arm) == ("manipulation", "tool")
        film.check_robot("manipulation_sawyer")

    def test_a_wrong_arm_is_told_at_once(self):
        with pytest.raises(ValueError, match="unknown arm 'sawer'; closest is 'sawyer', allowed are sawyer, tool"):
            Space(arm="sawer")

    def test_places_seen_by_the_robot_are_mirrored(self):
        places = np.array([[0.1, 0.2], [0.9, 0.0]])
        np.testing.assert_allclose(mirror_places(places), [[0.8, 0.2], [0.0, 0.0]], atol=1e-9)


def test_the_arm_in_mjx_goes_through_the_whole_program():
    """Traced, not compiled."""
    config, hparams = PRESETS["fast"]
    trainer = make_trainer(envs.make("manipulation_sawyer"), config)
    start = jax.eval_shape(trainer.init, jax.random.key(0), envs.load_target("manipulation_sawyer", "B"), hparams)
    warm = jax.eval_shape(trainer.warmup, start, Clock.start(), hparams)
    assert jax.eval_shape(trainer.chunk, *warm, hparams)[:2] == warm
    assert warm[0] == start
