"""The Sawyer arm: its geometry, what it does with the cans, and its films."""

from __future__ import annotations

import ctypes.util
import itertools
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image

import envs
from envs.manipulation import Space, table_scene
from envs.manipulation.push import TOOL_START, stroke
from envs.manipulation.sawyer import camera, motion, replay, stage
from envs.manipulation.sawyer.arm import BASE, FLANGE, LINKS, STICK
from envs.manipulation.sawyer.kinematics import REST, Kinematics, arm_model, limits
from envs.manipulation.scene import TOOL_HALF, TOOL_HEIGHT
from envs.manipulation.table import DIRECTIONS, landscape
from envs.manipulation.targets import DEMONSTRATIONS
from experiments import film
from experiments.episodes import Episode
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


def off_course(plan):
    """Metres that the planned joint angles put the tip off its course during the stroke, at most."""
    kinematics = Kinematics()
    steps = range(plan.stroke[0], plan.stroke[1], 5)
    return max(np.linalg.norm(kinematics.pose(plan.joints[step])[0] - plan.points[step]) for step in steps)


def check_joints(plan):
    lower, upper = limits().T
    assert (plan.joints > lower + 0.05).all()
    assert (plan.joints < upper - 0.05).all()
    around = np.delete(plan.speeds, slice(plan.stroke[0] - 2, plan.stroke[1] + 2), axis=0)
    assert (np.abs(around) <= [link.speed for link in LINKS]).all()


class TestMotion:
    @pytest.mark.parametrize("place", [(0.01, 0.01), (0.45, 0.0), (0.03, 0.57), (0.87, 0.57), (0.45, 0.3)])
    def test_cans_anywhere_are_in_reach_from_all_sides(self, place):
        planner = motion.Planner(table((45, 30)))
        for ahead in DIRECTIONS:
            plan = planner.push(np.array(place), ahead.astype(float))
            assert off_course(plan) < 1e-3
            check_joints(plan)
            assert len(plan.joints) * table_scene.TIMESTEP < 8

    @pytest.mark.parametrize("place", [(0.841, 0.518), (0.069, 0.534)])
    def test_the_far_row_is_reached_at_once_from_rest(self, place):
        """Where a stretched elbow would flip, no patience keeps it within its speed."""
        plan = motion.Planner(table((45, 30))).push(np.array(place), np.array([0.0, -1.0]))
        check_joints(plan)
        assert len(plan.joints) * table_scene.TIMESTEP < 8

    def test_the_stroke_is_that_of_the_task_space(self):
        plan = motion.Planner(table((45, 30))).push(np.array([0.45, 0.3]), np.array([0.0, 1.0]))
        first, last = plan.stroke
        way = plan.points[first - 1 : last] - plan.points[first - 1]
        times = jnp.asarray(np.arange(len(way)) * table_scene.TIMESTEP, jnp.float32)
        np.testing.assert_allclose(way[:, 1], jax.vmap(stroke)(times)[0], atol=1e-5)
        assert (way[:, [0, 2]] == 0).all()
        np.testing.assert_allclose(plan.points[first - 1], [0.45, 0.3 + TOOL_START, TOOL_HEIGHT], atol=1e-9)

    def test_the_tip_rises_over_what_is_in_its_way(self):
        task = table((15, 30), (75, 30), extra="cylinder 45 30 5 25")
        planner = motion.Planner(task)
        planner.push(np.array([0.15, 0.3]), np.array([1.0, 0.0]))
        plan = planner.push(np.array([0.75, 0.3]), np.array([-1.0, 0.0]))
        over = np.linalg.norm(plan.points[:, :2] - (0.45, 0.3), axis=1) < 0.05
        assert over.any()
        assert plan.points[over, 2].min() > 0.25 + TOOL_HALF[2]


class TestMirror:
    def test_twice_is_nothing(self):
        task = envs.load_target("manipulation", "out_of_space")
        twice = stage.mirror(stage.mirror(task))
        jax.tree.map(lambda ours, theirs: np.testing.assert_allclose(ours, theirs, atol=1e-6), twice, task)

    def test_heights_are_where_they_were_seen_from_the_other_side(self):
        task = envs.load_target("manipulation", "out_of_space")
        points = np.random.default_rng(0).uniform((0, 0), (0.9, 0.6), (500, 2)).astype(np.float32)
        turned = points * np.array([-1, 1], np.float32) + np.array([0.9, 0], np.float32)
        there = np.asarray(landscape(stage.mirror(task), jnp.asarray(turned)))
        assert (there == np.asarray(landscape(task, jnp.asarray(points)))).mean() > 0.99  # rounding, at edges


class Witness:
    """Watches a replay: what touches the cans, what moves by itself, rises or sinks in, and how close the arm comes.

    Attributes:
      touched, pushed: geoms of the robot that met something, and what they met.
      floating: metres that a can went that nothing had met yet.
      lifted: metres that a can rose above where it stands, at most.
      deepest: metres that two things were in each other, at most.
      closest: metres between the arm and anything, or the tool and anything but cans; looked at every 10 ms.
    """

    def __init__(self):
        self.touched, self.pushed, self.steps = set(), set(), 0
        self.floating, self.lifted, self.deepest, self.closest = 0.0, 0.0, 0.0, np.inf

    def __call__(self, model, data):
        if self.steps == 0:
            self.begin(model, data)
        self.steps += 1
        if data.ncon:
            self.deepest = max(self.deepest, -float(data.contact.dist.min()))
        for pair in data.contact.geom[data.contact.dist <= 0]:
            pair = {self.names[i] for i in pair}
            if parts := {part for part in pair if part.startswith("sawyer")}:
                self.touched |= parts
                self.pushed |= pair - parts
        for can, joint in self.cans.items():
            moved = data.qpos[joint : joint + 3] - self.start[joint : joint + 3]
            self.lifted = max(self.lifted, moved[2])
            if can not in self.pushed:
                self.floating = max(self.floating, np.abs(moved[:2]).max())
        if self.steps % 10 == 0:
            self.look(model, data)

    def begin(self, model, data):
        self.start = data.qpos.copy()
        self.names = [model.geom(i).name for i in range(model.ngeom)]
        self.cans = {can: model.joint(can).qposadr[0] for can in ("can0", "can1", "can2")}
        owner = [model.body(body).name for body in model.geom_bodyid]
        arm = [i for i in range(model.ngeom) if owner[i].startswith("sawyer/right_l")]
        things = [i for i in range(model.ngeom) if self.names[i].startswith(("ground", "obstacle", "can"))]
        tool = [model.geom("sawyer/tip").id, model.geom("sawyer/stick").id]
        solid = [i for i in things if not self.names[i].startswith("can")]
        self.pairs = np.array([*itertools.product(arm, things), *itertools.product(tool, solid)])

    def look(self, model, data):
        """Pairs whose bounding spheres are further apart than the closest pair was need no closer look."""
        centers, radii = data.geom_xpos[self.pairs], model.geom_rbound[self.pairs]
        bound = np.linalg.norm(centers[:, 0] - centers[:, 1], axis=1) - radii.sum(axis=1)
        for pair in self.pairs[bound < self.closest]:
            self.closest = min(self.closest, mujoco.mj_geomDistance(model, data, *pair, 1.0, None))


@pytest.fixture(scope="module", params=list(DEMONSTRATIONS))
def demonstrated(request):
    """Pushes, plans and a witness of a demonstration played by the arm."""
    task, plans, witness = envs.load_target("manipulation", request.param), [], Witness()
    with pytest.MonkeyPatch.context() as patch:
        push = motion.Planner.push
        patch.setattr(motion.Planner, "push", lambda *args: plans.append(push(*args)) or plans[-1])
        pushes = replay.replay(task, np.asarray(task.goal, float), DEMONSTRATIONS[request.param], witness)
    return request.param, pushes, plans, witness


class TestDemonstrations:
    def test_the_arm_succeeds(self, demonstrated):
        name, pushes, _, _ = demonstrated
        assert len(pushes) == len(DEMONSTRATIONS[name])
        assert [push.event for push in pushes] == [""] * len(pushes)
        assert [push.success for push in pushes] == [False] * (len(pushes) - 1) + [True]

    def test_plans_are_exact_and_within_what_the_joints_can_do(self, demonstrated):
        _, pushes, plans, _ = demonstrated
        assert len(plans) == len(pushes)
        for plan in plans:
            assert off_course(plan) < 1e-3
            check_joints(plan)
            assert (np.abs(plan.speeds).max(axis=0) <= [link.speed for link in LINKS]).all()

    def test_the_motors_keep_the_tip_on_its_course(self, demonstrated):
        assert max(push.tracking for push in demonstrated[1]) < 1e-3

    def test_cans_move_because_the_tip_touches_them(self, demonstrated):
        name, _, _, witness = demonstrated
        assert witness.touched == {"sawyer/tip"}
        assert witness.pushed == {f"can{action // 4}" for action in DEMONSTRATIONS[name]}
        assert witness.floating < 1e-4

    def test_nothing_passes_through_anything(self, demonstrated):
        _, _, _, witness = demonstrated
        assert witness.closest > 0.005
        assert witness.deepest < 0.001

    def test_cans_stay_on_the_table(self, demonstrated):
        assert demonstrated[3].lifted < 0.001


class TestReplay:
    def test_random_pushes_end_as_in_the_task_space(self):
        cases = random_cases(PUSHES)
        outcome = push_all(cases)
        ours = np.select([outcome.fell, outcome.hit], ["fell", "hit"], "")
        played = [replay.replay(task, np.array([0.7, 0.21]), [4 * can + to])[0] for task, can, to in cases]
        events = np.array([push.event for push in played])
        places = np.array([push.cans[can] for push, (_, can, _) in zip(played, cases, strict=True)])
        assert (events == ours).mean() >= 0.98
        calm = (events == "") & (ours == "")
        assert calm.sum() > PUSHES // 3
        assert np.linalg.norm(places - outcome.position, axis=-1)[calm].mean() <= 0.002

    def test_cans_that_are_not_pushed_stay(self):
        task = table((45, 30), (20, 15), (70, 45))
        (push,) = replay.replay(task, np.array([0.1, 0.5]), [4 * GREEN + RIGHT])
        np.testing.assert_allclose(push.cans[[0, 2]], task.cans[np.array([0, 2])], atol=1e-4)
        assert push.cans[GREEN][0] > 0.29

    def test_pushes_for_which_there_is_no_can_or_no_room_are_not_tried(self):
        task = table((30, 20), (39.5, 20))
        pushes = replay.replay(task, np.array([0.1, 0.5]), [4 * GREEN + RIGHT, 4 * BLUE + LEFT, 8])
        for push in pushes:
            np.testing.assert_allclose(push.cans[:2], task.cans[:2], atol=1e-6)
            assert (push.cans[2] == -1).all()
            assert (push.event, push.success) == ("", False)

    @pytest.mark.parametrize(
        ("place", "action", "event"), [((84, 30), RIGHT, "fell"), ((45, 4), NEAR, "fell"), ((52, 36), AWAY, "hit")]
    )
    def test_an_event_ends_the_episode(self, place, action, event):
        task = table(place, rows="FFFFFF\nFFFFFF\nFFFFFF\nFF.#FF")
        (push,) = replay.replay(task, np.array([0.1, 0.1]), [action, LEFT])
        assert (push.event, push.success) == (event, False)


def gif_frames(path):
    with Image.open(path) as image:
        return image.n_frames, image.size


class TestFilm:
    def test_without_graphics_the_film_is_from_above(self, tmp_path, monkeypatch, capsys):
        monkeypatch.delenv("MUJOCO_GL", raising=False)
        monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
        film.film(film.Args(tmp_path / "film.gif", target="A"))
        assert gif_frames(tmp_path / "film.gif") == (len(DEMONSTRATIONS["A"]) + 1, (192, 128))
        assert "libegl1" in capsys.readouterr().err

    def test_a_target_may_be_a_file(self, tmp_path):
        file = tmp_path / "one_push.txt"
        file.write_text("FFFFFF\nFFFFFF\nFFFFFF\nFFFFFF\ngoal 45 37\ncan 45 30\nrange 10")
        film.film(film.Args(tmp_path / "film.gif", target=str(file), robot=False))
        frames, _ = gif_frames(tmp_path / "film.gif")
        assert 2 <= frames <= 4

    def test_a_missing_backend_is_told_before_anything_else(self, monkeypatch):
        """MuJoCo then fails to be imported; None in its place makes it fail wherever the libraries are."""
        monkeypatch.setenv("MUJOCO_GL", "osmesa")
        monkeypatch.setitem(sys.modules, "mujoco", None)
        with pytest.raises(ValueError, match=r"MUJOCO_GL=osmesa names a library that does not load.* or unset MUJOCO_GL"):
            Space()

    def test_a_backend_that_has_a_window_is_refused(self, monkeypatch):
        monkeypatch.setenv("MUJOCO_GL", "glfw")
        with pytest.raises(camera.NoGraphics, match="allowed are egl and osmesa"):
            camera.Camera(arm_model())

    def test_the_robot_and_the_cans_are_in_the_picture(self):
        """Blue left of green, as from above, and the robot behind both."""
        task = stage.mirror(table((20, 30), (70, 30)))
        scene = replay.Scene(task, np.array([0.3, 0.2]), None)
        try:
            view = camera.Camera(scene.model)
        except camera.NoGraphics as error:
            pytest.skip(str(error))
        picture = view.picture(scene.data).astype(int)
        view.close()
        red, green, blue = np.moveaxis(picture, -1, 0)
        colors = [(blue > 2 * red) & (blue > 1.5 * green), (green > 2 * red) & (green > 1.5 * blue), (red > 3 * green)]
        (blue_y, blue_x), (green_y, green_x), (robot_y, robot_x) = (np.argwhere(color).mean(axis=0) for color in colors)
        assert blue_x < robot_x < green_x
        assert robot_y < min(blue_y, green_y)

    def test_the_arm_plays_an_episode(self, tmp_path, capsys):
        """One push to the goal: the can is where it was in the first picture, and elsewhere in the last."""
        task = table((52, 21))
        start, _ = Space().reset(jax.random.key(0), task)
        film.save(tmp_path / "film.gif", Space(), task, Episode([start._replace(goal=task.goal)], [RIGHT], True), robot=True)
        told = capsys.readouterr()
        if "install EGL" in told.err:
            pytest.skip(told.err)
        assert told.out == "the arm: success after 1 pushes\n"
        with Image.open(tmp_path / "film.gif") as film_:
            assert film_.size == stage.PICTURE
            pictures = []
            for index in (0, film_.n_frames - 1):
                film_.seek(index)
                pictures.append(np.asarray(film_.convert("RGB"), int))
        cans = [np.argwhere(picture[..., 2] > 1.5 * picture[..., :2].max(axis=-1)).mean(axis=0) for picture in pictures]
        assert cans[1][1] - cans[0][1] > 10

    def test_mistakes_are_told(self, tmp_path):
        (tmp_path / "file").touch()
        with pytest.raises(UsageError, match="is no directory"):
            film.film(film.Args(tmp_path / "file" / "film.gif"))
        with pytest.raises(UsageError, match="closest is 'A'"):
            film.film(film.Args(tmp_path / "film.gif", target="a"))
        with pytest.raises(UsageError, match="plays manipulation, not grid_world"):
            film.check_robot("grid_world")
