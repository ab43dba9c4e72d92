"""Targets, the search for shortest solutions, layouts and what names a task space."""

from __future__ import annotations

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.grid_world.layout import format_layout, parse_layout
from envs.grid_world.solver import solution_length, solve
from tests.boards import EMPTY, GOAL, LAVA, PLACE, SPACE, WALL, assert_step, layout, load_all, params, play

LAYOUTS = Path(__file__).parents[1] / "experiments" / "layouts"


class TestTargets:
    @pytest.mark.parametrize(("name", "steps", "best"), [("A", 22, 0.978), ("B", 36, 0.964), ("C", 29, 0.971)])
    def test_the_shortest_solution_replays(self, name, steps, best):
        task = envs.load_target("grid_world", name)
        plan = solve(task)
        outs = play(task, plan)
        assert len(plan) == steps
        assert outs[-1].success
        assert sum(float(out.reward) for out in outs) == pytest.approx(best, abs=1e-6)
        described = SPACE.describe(task, task)
        assert described["feasible"] == 1
        assert described["solution_length"] == steps

    def test_a_takes_one_key_and_b_and_c_take_both(self):
        keys = {name: play(task, solve(task))[-1].state.keys.tolist() for name, task in load_all().items()}
        assert keys == {"A": [True, False], "B": [True, True], "C": [True, True]}

    @pytest.mark.parametrize(("name", "steps", "keys"), [("three_rooms", 19, [True, True]), ("lava_garden", 26, [False, True])])
    def test_the_example_layouts_can_be_solved(self, name, steps, keys):
        task = parse_layout((LAYOUTS / f"{name}.txt").read_text())
        outs = play(task, solve(task))
        assert len(outs) == steps
        assert outs[-1].success
        assert outs[-1].state.keys.tolist() == keys

    @pytest.mark.parametrize("name", "ABC")
    def test_format_reads_back(self, name):
        assert format_layout(load_all()[name]) == SPACE.targets[name].strip()

    def test_a_parameter_yields_the_same_task(self):
        target = load_all()["C"]
        tiles = {(r, c): int(target.tiles[r, c]) for r in range(1, 9) for c in range(1, 9)}
        task = PLACE(params(objects=dict(enumerate(target.objects.tolist())), tiles=tiles))
        jax.tree.map(np.testing.assert_array_equal, task, target)

    def test_shares(self):
        described = SPACE.describe(load_all()["A"], load_all()["B"])
        assert (described["walls"], described["lava"]) == (6 / 64, 3 / 64)

    def test_distance_from_the_target(self):
        here = PLACE(params(objects={GOAL: (3, 4)}, tiles={(8, 8): WALL, (7, 7): LAVA}))
        there = PLACE(params(objects={GOAL: (1, 8)}, tiles={(8, 8): LAVA}))
        described = SPACE.describe(here, there)
        assert (described["tile_distance"], described["goal_distance"]) == (2 / 64, 6)
        assert SPACE.describe(here, here)["tile_distance"] == SPACE.describe(here, here)["goal_distance"] == 0
        assert jnp.isnan(SPACE.describe(PLACE(params()), there)["goal_distance"])


class TestSolver:
    @pytest.mark.parametrize(
        ("rows", "length"),
        [
            (["AG"], 1),
            (["A#", "##"], None),
            (["A.", "LL"], 14),  # lava is walked around
            (["AYG", "##"], None),  # the only way is through a door without key
            (["AyYG", "####"], 3),
            (["A..YG", "y####"], 6),  # 1 down to the key, 1 back, 4 right
            (["AbYG", "####"], None),  # the key is of the other colour
        ],
    )
    def test_lengths(self, rows, length):
        task = parse_layout(layout(*rows))
        plan = solve(task)
        assert (None if plan is None else len(plan)) == length
        np.testing.assert_equal(float(solution_length(task)), np.nan if length is None else float(length))

    def test_a_start_on_the_goal_has_no_solution(self):
        task = PLACE(params(objects={GOAL: (1, 1)}))
        described = SPACE.describe(task, task)
        assert solve(task) is None
        assert described["feasible"] == 0
        assert jnp.isnan(described["solution_length"])

    def test_a_task_without_goal_has_no_solution(self):
        task = PLACE(params())
        assert solve(task) is None
        assert SPACE.describe(task, task)["feasible"] == 0

    @pytest.mark.parametrize(("last_row", "length"), [("......y.", 50), (".....y..", None)])
    def test_the_horizon_bounds_solutions(self, last_row, length):
        """The key is 24 or 25 steps away, along the snake; then the same way back, the door and the goal."""
        snake = ["A.......", "Y######.", "G#......", "##.#####", "##......", "#######.", last_row, "########"]
        task = parse_layout("\n".join(snake))
        plan = solve(task)
        assert (None if plan is None else len(plan)) == length
        np.testing.assert_equal(float(solution_length(task)), np.nan if length is None else float(length))
        if plan is not None:
            assert_step(play(task, plan)[-1], position=(3, 1), reward=0.999, terminated=True, success=True)

    def test_both_searches_agree_on_random_tasks(self, varied_tasks):
        described = jax.device_get(jax.jit(jax.vmap(SPACE.describe))(varied_tasks, varied_tasks))
        plans = [solve(task) for task in unstack(varied_tasks)]
        lengths = np.array([np.nan if plan is None else len(plan) for plan in plans], np.float32)
        np.testing.assert_array_equal(described["solution_length"], lengths)
        np.testing.assert_array_equal(described["feasible"], np.isfinite(lengths))
        # Neither outcome may be so rare that agreement says little, and long solutions, which need keys, must occur.
        assert 100 < np.isfinite(lengths).sum() < 300
        assert (lengths > 20).sum() > 20

    def test_solutions_of_random_tasks_replay(self, varied_tasks):
        ends = [play(task, plan)[-1] for task in unstack(varied_tasks)[::10] if (plan := solve(task)) is not None]
        assert len(ends) > 10
        assert all(end.success for end in ends)
        assert any(end.state.keys.any() for end in ends)


@pytest.fixture(scope="module")
def varied_tasks():
    """400 tasks: 200 from nearly empty to uniformly random boards, then 200 targets with some tiles changed."""
    w = jax.jit(jax.vmap(SPACE.sample_uniform))(jax.random.split(jax.random.key(3), 400))
    emptier = jnp.linspace(0, 1, 200)[:, None, None]
    free = w["tiles"][:200].at[..., EMPTY].add(emptier)

    targets = jax.tree.map(lambda *leaves: np.stack([leaves[i % 3] for i in range(200)]), *load_all().values())
    like_target = jax.nn.one_hot(targets.tiles[:, 1:-1, 1:-1], 3) * jnp.linspace(0.6, 1, 200)[:, None, None, None]
    near = w["tiles"][200:] + like_target
    places = (targets.objects + 0.5).reshape(200, 10)
    return jax.jit(jax.vmap(SPACE.instantiate))(
        {"tiles": jnp.concatenate([free, near]), "xy": jnp.concatenate([w["xy"][:200], places])}
    )


def unstack(tasks):
    """A list of the tasks of a batch, fetched."""
    fetched = jax.device_get(tasks)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], fetched) for i in range(len(fetched.present))]


class TestLayoutErrors:
    @pytest.mark.parametrize(
        ("line", "row", "message"),
        [
            (3, "..x.....", "line 3, column 3: unknown character 'x', allowed are .AG#LYByb"),
            (3, "  ......", "line 3, column 1: unknown character ' '"),
            (2, ".......", "line 2: 7 columns, expected 8"),
            (2, ".........", "line 2: 9 columns, expected 8"),
            (4, "...G....", "line 8, column 8: a second 'G'"),
            (4, "A.......", "line 4, column 1: a second 'A'"),
            (1, ".A......", "line 1, column 2: 'A' must stand on the upper-left tile"),
            (4, "..Y..Y..", "line 4, column 6: a second 'Y'"),
            (4, "..B..B..", "line 4, column 6: a second 'B'"),
            (4, "..y..y..", "line 4, column 6: a second 'y'"),
            (4, "..b..b..", "line 4, column 6: a second 'b'"),
            (8, "........", "no 'G' in the layout"),
            (1, "........", "no 'A' in the layout"),
            (1, "", "7 rows, expected 8"),
            (1, "A.......\n........", "9 rows, expected 8"),
        ],
    )
    def test_the_message_names_the_place(self, line, row, message):
        rows = layout("A").split("\n")
        rows[line - 1] = row
        with pytest.raises(ValueError, match=re.escape(message)):
            SPACE.parse_target("\n".join(rows))

    def test_lines_count_from_the_top_of_the_file(self):
        with pytest.raises(ValueError, match="line 3, column 2"):
            SPACE.parse_target("\n\n" + layout("A?"))

    def test_an_empty_text(self):
        with pytest.raises(ValueError, match="0 rows, expected 8"):
            SPACE.parse_target("")

    def test_blank_lines_and_trailing_blanks_do_not_matter(self):
        text = "\n" + layout("A#").replace("\n", "  \r\n") + "\n\n"
        assert format_layout(SPACE.parse_target(text)) == layout("A#")


class TestRegistry:
    @pytest.mark.parametrize("wrong", ["gridworld", "grid-world", "Grid_World"])
    def test_a_wrong_space_gets_the_closest_name(self, wrong):
        with pytest.raises(
            ValueError, match=f"unknown task space '{wrong}'; closest is 'grid_world', allowed are .*grid_world"
        ):
            envs.make(wrong)

    def test_a_wrong_target_gets_the_closest_name(self):
        with pytest.raises(ValueError, match=r"unknown target of grid_world 'c'; closest is 'C', allowed are A, B, C"):
            envs.load_target("grid_world", "c")

    def test_a_file(self, tmp_path):
        path = tmp_path / "mine.txt"
        path.write_text(layout("A#", "L"))
        assert format_layout(envs.load_target_file("grid_world", path)) == layout("A#", "L")

    def test_a_wrong_file_is_named(self, tmp_path):
        path = tmp_path / "mine.txt"
        path.write_text(layout("A?"))
        with pytest.raises(ValueError, match=r"mine\.txt: line 1, column 2"):
            envs.load_target_file("grid_world", path)

    def test_every_space_is_called_by_its_name(self):
        assert [envs.make(name).name for name in envs.SPACES] == list(envs.SPACES)
