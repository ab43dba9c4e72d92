"""Targets and their demonstrations, the search for solutions, tables as text, descriptions and pictures."""

from __future__ import annotations

import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.manipulation import Space
from envs.manipulation.solver import solve
from envs.manipulation.targets import DEMONSTRATIONS
from tests.tables import BLUE, PIT, RIGHT, ROADBLOCK, SPACE, params, play, table

TARGETS = tuple(SPACE.targets)
PLACE = jax.jit(SPACE.instantiate)
describe = jax.jit(SPACE.describe)

A = "F...FF\nFFFFFF\nFFFFFF\nF...FF\ncan 13.8 31.3\ncan 36.9 37.2\ncan 57.2 22.1\nrange 10"


def pairs(actions):
    return [divmod(action, 4) for action in actions]


class TestTargets:
    def test_the_papers_three_and_one_outside_the_space(self):
        assert TARGETS == ("A", "B", "C", "out_of_space") == tuple(DEMONSTRATIONS)

    @pytest.mark.parametrize("name", TARGETS)
    def test_the_demonstration_succeeds_wherever_the_goal_is(self, name):
        task = envs.load_target("manipulation", name)
        for side in itertools.product((-1, 0, 1), repeat=2):
            goal = np.asarray(task.goal) + SPACE.goal_jitter * np.array(side)
            outs = play(task, pairs(DEMONSTRATIONS[name]), goal, whole=False)  # a near goal is reached early
            assert outs[-1].success
            assert sum(float(out.reward) for out in outs) == 1
        assert len(DEMONSTRATIONS[name]) <= SPACE.horizon

    @pytest.mark.parametrize("name", TARGETS)
    def test_cans_stand_where_they_were_measured(self, name):
        measured = {
            "A": [(13.8, 31.3), (36.9, 37.2), (57.2, 22.1)],
            "B": [(24.5, 4.9), (21.3, 33.2), (54.0, 39.5)],
            "C": [(15.3, 21.0), (45.5, 27.8), (14.7, 37.1)],
        }
        task = envs.load_target("manipulation", name)
        assert task.present.all()
        if name in measured:
            assert np.abs(100 * np.asarray(task.cans) - measured[name]).max() <= 1.5
            assert task.goal_range == np.float32(0.1)

    def test_a_has_a_table_that_a_parameter_can_make(self):
        target = envs.load_target("manipulation", "A")
        blocks = {(column, row): PIT for column in (1, 2, 3) for row in (0, 3)}
        task = PLACE(params(blocks=blocks))
        np.testing.assert_array_equal(task.ground, target.ground)
        assert not (np.asarray(task.obstacles.height) > 0).any()

    def test_roadblocks_of_b_are_those_of_a_parameter(self):
        target = envs.load_target("manipulation", "B")
        blocks = {(3, 0): ROADBLOCK, (4, 0): ROADBLOCK, (5, 0): ROADBLOCK, (3, 1): ROADBLOCK, (5, 1): ROADBLOCK}
        pits = dict.fromkeys([(2, 0), (2, 1), (5, 2), (2, 3), (5, 3)], PIT)
        described = describe(PLACE(params(blocks=blocks | pits)), target)
        assert described["block_distance"] == 0

    def test_the_space_cannot_make_the_table_out_of_space(self):
        ground = np.asarray(envs.load_target("manipulation", "out_of_space").ground).reshape(6, 6, 4, 6)
        per_block = ground.mean(axis=(1, 3))
        assert ((per_block > 0) & (per_block < 1)).any()


class TestSolver:
    @pytest.mark.parametrize("name", TARGETS)
    def test_it_finds_the_demonstrations(self, name):
        assert solve(envs.load_target("manipulation", name), SPACE.goal_jitter) == list(DEMONSTRATIONS[name])

    def test_one_push(self):
        assert solve(table((52, 21))) == [RIGHT]

    def test_a_can_in_the_way_is_pushed_aside(self):
        task = table((42, 21), (52.5, 21), rows="......\nFFFFF.\nFFFFF.\nFFFFF.")
        plan = solve(task)
        assert len(plan) == 3
        assert sum(action // 4 != BLUE for action in plan) == 1
        assert play(task, pairs(plan))[-1].success

    def test_what_cannot_be_reached(self):
        assert solve(table((20, 21), rows="FF.FFF\nFF.FFF\nFF.FFF\nFF.FFF")) is None
        assert solve(PLACE(params(blocks={(0, 0): PIT}))) is None


def message(text):
    with pytest.raises(ValueError, match=r"line|rows, expected|no '") as caught:
        SPACE.parse_target(text)
    return str(caught.value)


class TestTables:
    def test_what_is_read(self):
        task = SPACE.parse_target("\n" + A + "\ngoal 60 30\nbox 80 50 10 4 8 90\ncylinder 80 10 5 30\n")
        np.testing.assert_allclose(task.cans, [[0.138, 0.313], [0.369, 0.372], [0.572, 0.221]], atol=1e-6)
        np.testing.assert_allclose(task.goal, [0.6, 0.3])
        there = np.asarray(task.obstacles.height) > 0
        assert there.sum() == 2
        np.testing.assert_allclose(np.asarray(task.obstacles.half)[there], [[0.05, 0.02], [0, 0]], atol=1e-6)
        np.testing.assert_allclose(np.asarray(task.obstacles.axis)[there][0], [0, 1], atol=1e-6)
        np.testing.assert_allclose(np.asarray(task.obstacles.height)[there], [0.08, 0.3], atol=1e-6)

    def test_one_can_is_enough(self):
        assert table((20, 20)).present.tolist() == [True, False, False]

    @pytest.mark.parametrize(
        ("old", "new", "expected"),
        [
            ("F...FF\nFF", "F..xFF\nFF", "line 1, column 4: unknown character 'x', allowed are F.# and the words can, box"),
            ("F...FF\nFF", "F...F\nFF", "line 1, column 1: 5 columns, expected 6 blocks or 36 cells"),
            ("F...FF\nFF", "FF", "3 rows, expected 4 of blocks or 24 of cells"),
            ("can 36.9 37.2", "cam 36.9 37.2", "line 6, column 1: unknown character 'c'"),
            ("can 36.9 37.2", "can 36.9 3x", "line 6, column 10: '3x' is no number"),
            ("can 36.9 37.2", "can 36.9 nan", "line 6, column 10: 'nan' is no number"),
            ("can 36.9 37.2", "can 36.9", "line 6, column 1: 'can' takes 2 numbers, got 1"),
            ("can 36.9 37.2", "can 20 5", "line 6, column 5: the can's centre is not on the surface"),
            ("can 36.9 37.2", "can 91 30", "line 6, column 5: the can's centre is not on the surface"),
            ("can 36.9 37.2", "can 16 31", "line 6, column 5: the can, of radius 4.25, stands in another can"),
            ("can 57.2 22.1", "can 57.2 22.1\ncan 80 10", "line 8, column 1: a fourth 'can', allowed are 3"),
            ("range 10", "range 61", "line 8, column 7: range must be 10 to 60, got 61"),
            ("range 10", "range 10\ngoal 700 210", "line 9, column 6: the goal's x must be 0 to 90, got 700"),
            ("range 10", "range 10\ngoal 30 -1", "line 9, column 6: the goal's y must be 0 to 60, got -1"),
            ("range 10", "range 10\nrange 12", "line 9, column 1: a second 'range'"),
            ("range 10", "", "no 'range' in the table"),
            ("range 10", "range 10\nbox 14 30 5 5 5 0", "line 5, column 5: the can, of radius 4.25, stands in an obstacle"),
            ("range 10", "range 10\ncylinder 80 50 0 5", "line 9, column 1: sizes of a 'cylinder' must be above 0, got 0"),
            ("range 10", "range 10" + 25 * "\nbox 85 55 1 1 1 0", "line 33, column 1: more than 24 obstacles"),
        ],
    )
    def test_the_message_names_the_place(self, old, new, expected):
        assert message(A.replace(old, new, 1)).startswith(expected)

    def test_without_a_can(self):
        assert message("\n".join(["FFFFFF"] * 4 + ["range 10"])) == "no 'can' in the table"

    def test_cells_cannot_be_roadblocks(self):
        rows = ["F" * 36] * 24
        rows[2] = "F" * 5 + "#" + "F" * 30
        assert message("\n".join([*rows, "can 20 20", "range 10"])).startswith("line 3, column 6: a cell cannot be a roadblock")

    def test_a_file_that_is_wrong_is_named(self, tmp_path):
        path = tmp_path / "mine.txt"
        path.write_text(A.replace("can 13.8", "can x"))
        with pytest.raises(ValueError, match=re.escape("mine.txt: line 5, column 5: 'x' is no number")):
            envs.load_target_file("manipulation", path)


@pytest.mark.parametrize("jitter", [-0.1, float("nan"), float("inf")])
def test_a_jitter_that_is_no_length_is_refused(jitter):
    with pytest.raises(ValueError, match="goal_jitter must be finite and at least 0, got"):
        Space(goal_jitter=jitter)


class TestDescriptions:
    def test_by_hand(self):
        here = PLACE(params(blocks={(3, 3): PIT, (4, 3): ROADBLOCK, (5, 3): ROADBLOCK}, cans={0: (0, 0), 1: (2, 2)}, reach=0.4))
        there = PLACE(params(blocks={(3, 3): PIT}, cans={0: (1, 0), 1: (2, 3), 2: (5, 0)}))
        described = {name: float(value) for name, value in describe(here, there).items()}
        way = np.hypot(0.70 - 0.075, 0.21 - 0.075)
        expected = {
            "cans": 2,
            "target_can": 1,
            "pits": 1 / 24,
            "roadblocks": 2 / 24,
            "goal_range": 0.4,
            "goal_way": way,
            "block_distance": 2 / 24,
            "can_distance": 0.15,
        }
        assert described == pytest.approx(expected, abs=1e-6)

    def test_without_cans(self):
        nothing = PLACE(params(blocks={(0, 0): PIT}))
        described = describe(nothing, nothing)
        assert jnp.isnan(described["goal_way"])
        assert jnp.isnan(described["can_distance"])


class TestPictures:
    def pixel(self, picture, x, y, size=16):
        return tuple(picture[int(y / 15 * size), int(x / 15 * size)].tolist())

    def test_every_kind_has_its_colour(self):
        rows = "FFFFFF\nF.#FFF\nFFFFFF\nFFFFFF"
        task = table((20, 50), (40, 50), (60, 50), rows=rows, extra="cylinder 80 50 5 30", reach=30)
        picture = SPACE.render(task, tile_size=16)
        assert picture.shape == (64, 96, 3)
        assert picture.dtype == np.uint8
        places = [(5, 5), (22, 22), (37, 22), (20, 50), (40, 50), (60, 50), (80, 50), (70, 21)]
        assert len({self.pixel(picture, *place) for place in places}) == len(places)
        assert self.pixel(picture, 20, 50)[2] == max(self.pixel(picture, 20, 50))
        assert self.pixel(picture, 40, 50)[1] == max(self.pixel(picture, 40, 50))

    def test_cans_and_goal_are_where_the_state_has_them(self):
        task = table((20, 50))
        state, _ = SPACE.reset(jax.random.key(0), task)
        later = SPACE.render(task, state._replace(cans=state.cans.at[0].set(jnp.array([0.5, 0.5]))), tile_size=16)
        assert self.pixel(later, 50, 50) == self.pixel(SPACE.render(task, tile_size=16), 20, 50)
        assert self.pixel(later, 20, 50) == self.pixel(later, 5, 50)
        with pytest.raises(ValueError, match="tile_size"):
            SPACE.render(task, tile_size=0)
