"""Pushes against MuJoCo's own cylinders and boxes, and what a push must and must not do."""

from __future__ import annotations

import itertools
import math

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
import pytest

from envs.manipulation import scene
from envs.manipulation.placement import ground_of, roadblocks
from envs.manipulation.push import (
    GAP,
    REST_SPEED,
    STEPS,
    STROKE,
    STROKE_SECONDS,
    TOOL_RADIUS,
    TOOL_START,
    Drive,
    at_rest,
    push,
    simulate,
)
from envs.manipulation.table import BLOCK, CAN_RADIUS, DIRECTIONS, Task
from experiments.benchmarks import _true_shapes
from experiments.benchmarks.manipulation import same_model
from tests.tables import AWAY, BLUE, EMPTY, GREEN, LEFT, NEAR, RIGHT, push_all, table

PUSHES = 240


def random_cases(count, seed=0):
    """Pushes on random tables by cans anywhere, also half over an edge, where the tool has room and the can stands."""
    rng = np.random.default_rng(seed)
    tables = jax.jit(lambda blocks: (ground_of(blocks), roadblocks(blocks)))
    cases = []
    while len(cases) < count:
        blocks = rng.choice(3, (6, 4), p=[0.7, 0.15, 0.15])
        cans = rng.uniform((0.01, 0.01), (0.89, 0.59), (3, 2)).astype(np.float32)
        can, direction = int(rng.integers(3)), int(rng.integers(4))
        tool = cans[can] + TOOL_START * DIRECTIONS[direction]
        around = (cans[:, None] + 0.01 * np.concatenate([np.zeros((1, 2)), DIRECTIONS])[None]).reshape(-1, 2)
        columns, rows = np.floor(around / BLOCK).astype(int).clip(0, (5, 3)).T
        stands = (blocks[columns, rows] == 0).all()
        free = min(roadblock_distance(blocks, place) for place in cans) > CAN_RADIUS + 0.003
        apart = (np.linalg.norm(cans[:, None] - cans[None], axis=-1) + np.eye(3)).min() > 2 * CAN_RADIUS + 0.003
        others = np.linalg.norm(np.delete(cans, can, axis=0) - tool, axis=-1).min() - CAN_RADIUS
        if stands and free and apart and min(roadblock_distance(blocks, tool), others) > TOOL_RADIUS:
            ground, obstacles = jax.device_get(tables(blocks))
            goal = np.array([0.7, 0.21], np.float32)
            cases.append((Task(ground, obstacles, cans, np.ones(3, bool), goal, np.float32(0.1)), can, direction))
    return cases


def roadblock_distance(blocks, place):
    """Metres to the nearest roadblock's side; 1 if there is none."""
    centers = (np.argwhere(blocks == 2) + 0.5) * BLOCK
    return np.linalg.norm(np.maximum(np.abs(place - centers) - BLOCK / 2, 0), axis=-1).min(initial=1.0)


class TestTrueGeometry:
    def test_random_pushes_end_as_with_cylinders_and_boxes(self):
        cases = random_cases(PUSHES)
        outcome = push_all(cases)
        ends = [_true_shapes.push(task, can, direction) for task, can, direction in cases]
        places, true = np.array([place for place, _ in ends]), np.array([event for _, event in ends])
        ours = np.select([outcome.fell, outcome.hit], ["fell", "hit"], "")
        assert min((true == event).sum() for event in ("", "fell", "hit")) > PUSHES // 10
        assert (ours == true).mean() >= 0.98
        calm = (ours == "") & (true == "")
        errors = np.linalg.norm(outcome.position - places, axis=-1)[calm]
        assert errors.mean() <= 0.002
        assert np.quantile(errors, 0.95) <= 0.006
        assert np.linalg.norm(outcome.position - places, axis=-1)[(ours == "hit") & (true == "hit")].mean() <= 0.003


class TestPush:
    def test_a_free_can_moves_by_a_stroke_and_a_little_more_straight_ahead(self):
        task = table((45, 30))
        outcome = push_all([(task, BLUE, direction) for direction in range(4)])
        moved = outcome.position - np.asarray(task.cans[BLUE])
        along = np.sum(moved * DIRECTIONS, axis=-1)
        assert ((along >= STROKE) & (along <= STROKE + 0.01)).all()
        assert np.abs(moved - along[:, None] * DIRECTIONS).max() < 1e-4
        assert along.max() - along.min() < 1e-4
        assert not (outcome.fell | outcome.hit).any()

    @pytest.mark.parametrize("direction", range(4))
    @pytest.mark.parametrize("pit", [False, True])
    def test_it_falls_off_where_its_centre_passes_the_edge(self, direction, pit):
        """Of the table or of a pit.  Starts 2 mm apart: the first to fall would have come to rest within 1 cm of the edge."""
        (flat,) = push_all([(table((45, 30)), BLUE, direction)]).position
        stroke = float(np.sum((flat - np.array([0.45, 0.30])) * DIRECTIONS[direction]))
        rows = "FFFFFF\nFFF.FF\nFFFFFF\nFFFFFF" if pit else EMPTY
        near, far = (np.array([45.0, 15.0]), np.array([60.0, 30.0])) if pit else (np.array([90.0, 60.0]), np.zeros(2))
        ahead = DIRECTIONS[direction]
        edge = np.where(ahead > 0, near, np.where(ahead < 0, far, (near + far) / 2))
        gaps = 100 * stroke + np.arange(-1.5, 1.51, 0.2)
        cases = [(table(tuple(edge - ahead * gap), rows=rows), BLUE, direction) for gap in gaps]
        fell = push_all(cases).fell
        assert fell[0]
        assert not fell[-1]
        assert (np.diff(fell.astype(int)) <= 0).all()
        assert abs(gaps[fell].max() - 100 * stroke) <= 1.0

    def test_a_fall_is_told_at_the_edge(self):
        pit = table((24, 37), rows="FFFFFF\nFFFFFF\nFF.FFF\nFFFFFF")
        outcome = push_all([(table((84, 30)), BLUE, RIGHT), (pit, BLUE, RIGHT)])
        assert outcome.fell.all()
        assert 0.90 <= outcome.position[0, 0] <= 0.945
        assert 0.30 <= outcome.position[1, 0] <= 0.345

    @pytest.mark.parametrize(("gap", "hit"), [(0.5, False), (-0.5, True)])
    def test_a_roadblock_passed_beside(self, gap, hit):
        """Along each side of (45, 15) to (60, 30); the can's centre passes at its radius and a gap in centimetres."""
        rows = "FFFFFF\nFFF#FF\nFFFFFF\nFFFFFF"
        cases = []
        for direction, side in itertools.product(range(4), (-1, 1)):
            beside = side * (7.5 + 100 * CAN_RADIUS + gap) * DIRECTIONS[(direction + 1) % 4]
            start = np.array([52.5, 22.5]) + beside - 14.5 * DIRECTIONS[direction]
            cases.append((table(tuple(start), rows=rows), BLUE, direction))
        outcome = push_all(cases)
        assert (outcome.hit == hit).all()
        assert not outcome.fell.any()

    @pytest.mark.parametrize(("gap", "hit"), [(0.5, False), (-0.5, True)])
    def test_a_can_passed_beside(self, gap, hit):
        outcome = push_all([(table((30, 20), (38, 20 + 200 * CAN_RADIUS + gap)), BLUE, RIGHT)])
        assert outcome.hit == [hit]

    def test_a_hit_is_where_they_touch(self):
        rows = "FFFFFF\nFFFF#F\nFFFFFF\nFFFFFF"
        outcome = push_all([(table((50, 22), rows=rows), BLUE, RIGHT), (table((30, 22), (44, 22)), BLUE, RIGHT)])
        assert outcome.hit.all()
        np.testing.assert_allclose(outcome.position[:, 0], [0.60 - CAN_RADIUS, 0.44 - 2 * CAN_RADIUS], atol=0.003)

    def test_nothing_moves_without_room_for_the_tool(self):
        wall = table((35, 22), rows="FFFFFF\nF#FFFF\nFFFFFF\nFFFFFF")
        cans = table((30, 20), (39.5, 20))
        blocked = [(wall, BLUE, RIGHT), (cans, GREEN, RIGHT), (cans, BLUE, LEFT)]
        outcome = push_all([*blocked, (wall, BLUE, NEAR), (wall, BLUE, AWAY)])
        np.testing.assert_array_equal(outcome.position[:3], [wall.cans[BLUE], cans.cans[GREEN], cans.cans[BLUE]])
        assert not outcome.hit.any()
        assert not outcome.fell.any()
        assert (np.linalg.norm(outcome.position[3:] - np.asarray(wall.cans[BLUE]), axis=-1) > 0.1).all()

    def test_nothing_moves_if_the_can_is_absent(self):
        task = table((30, 20))
        outcome = push_all([(task, GREEN, RIGHT)])
        np.testing.assert_array_equal(outcome.position[0], task.cans[GREEN])
        assert not outcome.hit
        assert not outcome.fell

    def test_a_simulation_that_comes_apart_is_a_fall_where_it_still_held_together(self):
        def advance(motion, supported):
            moved = motion._replace(qpos=motion.qpos.at[0].add(0.001), steps=motion.steps + 1)
            broken = motion._replace(qpos=motion.qpos * jnp.nan)
            return jax.tree.map(lambda a, b: jnp.where(motion.steps < 10, a, b), moved, broken)

        task = table((30, 20))
        drive = Drive(at_rest(), 1, advance)
        outcome = push(
            task, task.cans, task.present, can=jnp.int32(BLUE), direction=jnp.int32(RIGHT), arm=lambda place, ahead: drive
        )
        assert (bool(outcome.fell), bool(outcome.hit)) == (True, False)
        np.testing.assert_allclose(outcome.position, [0.31, 0.20], atol=1e-6)

    def test_an_outcome_does_not_depend_on_what_is_pushed_beside_it(self):
        cases = random_cases(8, seed=1)
        together, apart = push_all(cases), [push_all([case]) for case in cases]
        for index, alone in enumerate(apart):
            np.testing.assert_allclose(together.position[index], alone.position[0], atol=1e-6)
            assert (together.fell[index], together.hit[index]) == (alone.fell[0], alone.hit[0])


def mechanics(model, motion):
    """Kinetic and potential energy of the can in joules, by MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = motion.qpos, motion.qvel
    data.qpos[7], data.qvel[6] = TOOL_START, 0
    mujoco.mj_forward(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    # The tool slides horizontally, so that its potential energy is a constant.
    return data.energy[1], data.energy[0]


class TestMechanics:
    @pytest.fixture(scope="class")
    @staticmethod
    def model():
        return mujoco.MjModel.from_xml_string(scene.push_xml())

    @pytest.fixture(scope="class")
    @staticmethod
    def run():
        """Motions over 120 time steps, or several times as many, from any velocity, where there is ground or none.

        At first=-1000 the tool's motion has not begun for long: it stays where it starts.
        """

        @jax.jit
        def roll(start, ground):
            def step(motion, _):
                after = simulate(motion, lambda feet: jnp.broadcast_to(ground, len(feet)))
                return after, after

            return jax.lax.scan(step, start, length=120)

        def repeat(velocity, first, times=1, ground=True):
            motion, parts = at_rest()._replace(qvel=velocity, steps=jnp.int32(first)), []
            for _ in range(times):
                motion, part = roll(motion, ground)
                parts.append(jax.device_get(part))
            return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

        return repeat

    @pytest.fixture(scope="class")
    @staticmethod
    def pushed(run):
        return run(jnp.zeros(7), first=0)

    def test_a_can_left_alone_for_three_seconds_stays_put(self, run):
        motion = run(jnp.zeros(7), first=-1000, times=5)
        assert len(motion.steps) * scene.TIMESTEP >= 3
        assert np.abs(motion.qpos[:, :2]).max() < 1e-5
        assert np.abs(motion.qpos[:, 2]).max() < 3e-4  # it settles by a quarter of a millimetre
        assert np.abs(motion.qvel[-1]).max() < 1e-4

    def test_no_energy_is_gained_at_rest(self, run, model):
        motion = run(jnp.zeros(7), first=-1000)
        start = sum(mechanics(model, at_rest()))
        energies = [sum(mechanics(model, jax.tree.map(lambda leaf, i=i: leaf[i], motion))) for i in range(0, 120, 10)]
        assert max(energies) <= start + 1e-6

    def test_a_sliding_can_loses_what_friction_takes(self, run, model):
        """From 0.5 m/s it slides v^2 / (2 mu g), and its energy falls by mu m g per metre on the way.

        MuJoCo moves by the velocity at a time step's end, which is half a time step's loss of velocity short of the mean.
        """
        speed = 0.5
        velocity = jnp.zeros(7).at[0].set(speed)
        motion = run(velocity, first=-1000)
        way = motion.qpos[:, 0] + scene.TIMESTEP * (speed - motion.qvel[:, 0]) / 2
        np.testing.assert_allclose(way[-1], speed**2 / (2 * scene.FRICTION * scene.GRAVITY), rtol=0.01)
        force = scene.FRICTION * scene.MASS * scene.GRAVITY
        kinetic = np.array([mechanics(model, jax.tree.map(lambda leaf, i=i: leaf[i], motion))[0] for i in range(20)])
        np.testing.assert_allclose(kinetic + force * way[:20], scene.MASS * speed**2 / 2, rtol=0.01)

    def test_without_ground_it_falls_freely(self, run, model):
        """By g t^2 / 2 (in steps of h, g h^2 n (n + 1) / 2), spinning on; its energy changes by that rounding alone.

        Not so along x and y, where friction acts in the air as well (see `scene`).
        """
        motion = run(jnp.zeros(7).at[5].set(2.0), first=-1000, ground=False)
        count = np.arange(1, 121)
        fallen = scene.GRAVITY * scene.TIMESTEP**2 * count * (count + 1) / 2
        np.testing.assert_allclose(motion.qpos[:, 2], -fallen, rtol=1e-3)
        np.testing.assert_allclose(motion.qpos[:, :2], 0, atol=1e-6)
        np.testing.assert_allclose(motion.qvel[:, 5], 2.0, rtol=1e-4)
        np.testing.assert_allclose(
            2 * np.arctan2(motion.qpos[:, 6], motion.qpos[:, 3]), 2.0 * scene.TIMESTEP * count, rtol=1e-3
        )
        start, end = (sum(mechanics(model, jax.tree.map(lambda leaf, i=i: leaf[i], motion))) for i in (0, -1))
        lost = scene.MASS * scene.GRAVITY**2 * scene.TIMESTEP**2 * (count[-1] - 1) / 2
        np.testing.assert_allclose(start - end, lost, rtol=0.02)

    def test_the_tool_follows_its_stroke(self, pushed):
        tool = pushed.qpos[:, 7] - TOOL_START
        after = round(STROKE_SECONDS / scene.TIMESTEP)
        np.testing.assert_allclose(tool[after:], STROKE + GAP, atol=1e-3)
        assert (np.diff(tool) >= -1e-4).all()

    def test_the_can_never_lags_behind_the_tool_or_leaves_the_ground(self, pushed):
        behind = pushed.qpos[:, 0] - (pushed.qpos[:, 7] - TOOL_START - GAP)
        assert behind.min() > -0.002
        assert np.abs(pushed.qpos[:, 2]).max() < 5e-4

    def test_the_can_rests_when_a_push_is_over(self, pushed):
        assert np.abs(pushed.qvel[STEPS - 1, :6]).max() < 4 * REST_SPEED
        tilt = 2 * np.arcsin(np.linalg.norm(pushed.qpos[:, 4:6], axis=-1))
        assert math.degrees(tilt.max()) < 1

    def test_quaternions_keep_their_length(self, pushed):
        np.testing.assert_allclose(np.linalg.norm(pushed.qpos[:, 3:7], axis=-1), 1, atol=1e-5)

    def test_mujoco_itself_moves_the_same_model_the_same_way(self, pushed, model):
        """One push in C, on ground everywhere; solved to convergence where ours takes one iteration."""
        model = mujoco.MjModel.from_xml_string(scene.push_xml().replace(scene.SOLVER, 'solver="Newton"'))
        data = mujoco.MjData(model)
        for step in range(STEPS):
            phase = math.pi * min(step * scene.TIMESTEP / STROKE_SECONDS, 1)
            data.qpos[7] = TOOL_START + (STROKE + GAP) / 2 * (1 - math.cos(phase))
            data.qvel[6] = (STROKE + GAP) / 2 * math.pi / STROKE_SECONDS * math.sin(phase)
            mujoco.mj_step(model, data)
            np.testing.assert_allclose(pushed.qpos[step, :3], data.qpos[:3], atol=0.002)


@pytest.mark.relaxed("dtype")  # as the script runs
def test_the_benchmark_times_the_same_push_in_mujoco():
    model, data, state, control = same_model()
    states, _ = mujoco.rollout.rollout(model, data, state[None], control[None])
    moved = push_all([(table((45, 30)), BLUE, RIGHT)]).position[0] - np.array([0.45, 0.30])
    np.testing.assert_allclose(states[0, -1, 1:3], moved, atol=0.004)  # after the time: x and y; the servo lags
