"""Every rule of Grid-World, on small maps and with exact numbers."""

from __future__ import annotations

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from apt_jax.specs import obs_struct, param_struct
from envs.grid_world.dynamics import MOVES
from envs.grid_world.layout import format_layout, parse_layout
from envs.grid_world.solver import solution_length, solve

UP, RIGHT, DOWN, LEFT = range(4)
EMPTY, WALL, LAVA = range(3)
GOAL, YELLOW_DOOR, BLUE_DOOR, YELLOW_KEY, BLUE_KEY = range(5)

SPACE = envs.make("grid_world")
STEP = jax.jit(SPACE.step)
PLACE = jax.jit(SPACE.instantiate)


def layout(*top: str) -> str:
    """A layout whose first rows are `top`, padded with floor; G stands in the far corner unless `top` has one."""
    rows = [row.ljust(8, ".") for row in top] + ["........"] * (8 - len(top))
    if "G" not in "".join(rows):
        rows[-1] = rows[-1][:-1] + "G"
    return "\n".join(rows)


def play(task, actions):
    """The step outputs of `actions` from the start of an episode; nothing may follow the end of it."""
    state, _ = SPACE.reset(jax.random.key(0), task)
    outs = []
    for action in actions:
        assert not (outs and (outs[-1].terminated or outs[-1].truncated)), "the episode is over"
        outs.append(STEP(state, jnp.int32(action), task))
        state = outs[-1].state
    return outs


def assert_step(out, *, position, reward, terminated=False, truncated=False, success=False):
    assert out.state.position.tolist() == list(position)
    assert out.reward == np.float32(reward)
    assert (bool(out.terminated), bool(out.truncated), bool(out.success)) == (terminated, truncated, success)


def params(objects=(), tiles=()) -> dict[str, jax.Array]:
    """A parameter with categories `tiles` {(row, column): category} on floor, and `objects` {index: (row, column)}.

    Positions are on the 10 x 10 board; objects that are not named lie on the border.
    """
    scores = np.zeros((8, 8, 3), np.float32)
    scores[..., EMPTY] = 1
    for (row, column), category in dict(tiles).items():
        scores[row - 1, column - 1] = np.eye(3)[category]
    xy = np.zeros((5, 2), np.float32)
    for index, place in dict(objects).items():
        xy[index] = np.array(place) + 0.5
    return {"tiles": jnp.asarray(scores), "xy": jnp.asarray(xy.reshape(10))}


class TestRewardsAndEnds:
    @pytest.mark.parametrize(
        ("action", "position"),
        [(RIGHT, (2, 3)), (DOWN, (3, 2)), (LEFT, (2, 1)), (UP, (1, 2))],
    )
    def test_a_move_costs_a_thousandth(self, action, position):
        *_, out = play(parse_layout(layout("A")), [RIGHT, DOWN, action])
        assert_step(out, position=position, reward=-0.001)

    @pytest.mark.parametrize("action", [UP, LEFT])
    def test_border(self, action):
        (out,) = play(parse_layout(layout("A")), [action])
        assert_step(out, position=(1, 1), reward=-0.002)

    def test_inner_wall(self):
        (out,) = play(parse_layout(layout("A#")), [RIGHT])
        assert_step(out, position=(1, 1), reward=-0.002)

    def test_lava_ends_the_episode_in_front_of_it(self):
        (out,) = play(parse_layout(layout("AL")), [RIGHT])
        assert_step(out, position=(1, 1), reward=-0.501, terminated=True)

    @pytest.mark.parametrize("door", "YB")
    def test_closed_door_ends_the_episode_in_front_of_it(self, door):
        (out,) = play(parse_layout(layout("A" + door)), [RIGHT])
        assert_step(out, position=(1, 1), reward=-0.501, terminated=True)

    def test_goal(self):
        (out,) = play(parse_layout(layout("AG")), [RIGHT])
        assert_step(out, position=(1, 2), reward=0.999, terminated=True, success=True)

    def test_horizon_truncates_at_step_50(self):
        outs = play(parse_layout(layout("A")), [UP] * 50)
        assert not any(out.truncated or out.terminated for out in outs[:49])
        assert_step(outs[49], position=(1, 1), reward=-0.002, truncated=True)

    @pytest.mark.parametrize(("tile", "reward", "success"), [("G", 0.999, True), ("L", -0.501, False)])
    def test_an_end_at_step_50_is_a_termination(self, tile, reward, success):
        *_, out = play(parse_layout(layout("A" + tile)), [UP] * 49 + [RIGHT])
        assert_step(out, position=(1, 2) if success else (1, 1), reward=reward, terminated=True, success=success)

    @pytest.mark.parametrize("action", range(4))
    def test_starting_on_the_goal_costs_exactly_one(self, action):
        task = PLACE(params(objects={GOAL: (1, 1), YELLOW_KEY: (1, 2)}, tiles={(2, 1): LAVA}))
        (out,) = play(task, [action])
        assert_step(out, position=(1, 1), reward=-1.0, terminated=True)
        assert not out.state.keys.any()


class TestKeysAndDoors:
    @pytest.mark.parametrize(("row", "key"), [("AyYG", 0), ("AbBG", 1)])
    def test_a_key_opens_the_door_of_its_colour(self, row, key):
        take, through, goal = play(parse_layout(layout(row)), [RIGHT] * 3)
        assert_step(take, position=(1, 2), reward=-0.001)
        assert take.state.keys.tolist() == [key == 0, key == 1]
        assert_step(through, position=(1, 3), reward=-0.001)
        assert_step(goal, position=(1, 4), reward=0.999, terminated=True, success=True)

    @pytest.mark.parametrize("row", ["AyB", "AbY"])
    def test_a_key_leaves_the_other_door_closed(self, row):
        _, out = play(parse_layout(layout(row)), [RIGHT] * 2)
        assert_step(out, position=(1, 2), reward=-0.501, terminated=True)

    def test_a_key_without_door_can_be_taken(self):
        (out,) = play(parse_layout(layout("Ay")), [RIGHT])
        assert_step(out, position=(1, 2), reward=-0.001)
        assert out.state.keys.tolist() == [True, False]

    def test_taken_key_and_open_door_vanish_from_the_observation(self):
        task = parse_layout(layout("AyY"))
        _, before = SPACE.reset(jax.random.key(0), task)
        assert before["objects"].tolist() == [7, 7, 0, 2, 0, 0, 0, 1, 0, 0]
        (out,) = play(task, [RIGHT])
        assert out.obs["objects"].tolist() == [7, 6, 0, 0, 0, 0, 0, 0, 0, 0]


class TestObservation:
    def test_view_is_centred_and_walled_in(self):
        task = parse_layout(layout("A.L", ".#."))
        _, obs = SPACE.reset(jax.random.key(0), task)
        assert obs["agent"].tolist() == [1, 1]
        assert obs["view"].tolist() == [
            [1, 1, 1, 1, 1, 1, 1],
            [1, 1, 1, 1, 1, 1, 1],
            [1, 1, 1, 1, 1, 1, 1],
            [1, 1, 1, 0, 0, 2, 0],
            [1, 1, 1, 0, 1, 0, 0],
            [1, 1, 1, 0, 0, 0, 0],
            [1, 1, 1, 0, 0, 0, 0],
        ]

    def test_view_in_the_far_corner(self):
        *_, out = play(parse_layout(layout("A......G")), [DOWN] * 7 + [RIGHT] * 7)
        assert out.obs["agent"].tolist() == [8, 8]
        assert out.obs["view"].tolist() == [[0] * 4 + [1] * 3] * 4 + [[1] * 7] * 3
        assert out.obs["objects"].tolist()[:2] == [-7, 0]

    def test_shapes_and_dtypes_are_those_of_the_spec(self):
        task = parse_layout(layout("A"))
        _, first = SPACE.reset(jax.random.key(0), task)
        (out,) = play(task, [RIGHT])
        for obs in (first, out.obs):
            assert jax.eval_shape(lambda obs=obs: obs) == obs_struct(SPACE.obs_spec)


class TestPlacement:
    def test_every_object_stands_where_it_was_put(self):
        places = {GOAL: (8, 8), YELLOW_DOOR: (3, 4), BLUE_DOOR: (5, 1), YELLOW_KEY: (1, 8), BLUE_KEY: (8, 1)}
        task = PLACE(params(objects=places))
        assert format_layout(task).split() == [
            "A......y",
            "........",
            "...Y....",
            "........",
            "B.......",
            "........",
            "........",
            "b......G",
        ]

    @pytest.mark.parametrize("category", [WALL, LAVA])
    @pytest.mark.parametrize("index", range(5))
    def test_the_tile_under_an_object_becomes_floor(self, index, category):
        task = PLACE(params(objects={index: (3, 4)}, tiles={(3, 4): category, (3, 5): category}))
        assert task.present[index]
        assert task.tiles[3, 4] == EMPTY
        assert task.tiles[3, 5] == category

    @pytest.mark.parametrize("place", [(0, 4), (9, 4), (4, 0), (4, 9), (0, 0), (9, 9)])
    @pytest.mark.parametrize("index", range(5))
    def test_no_object_on_the_border(self, index, place):
        task = PLACE(params(objects={index: place}))
        assert not task.present.any()
        assert (np.asarray(task.tiles)[place]) == WALL

    @pytest.mark.parametrize(("earlier", "later"), [(i, j) for j in range(5) for i in range(j)])
    def test_the_earlier_object_keeps_a_shared_tile(self, earlier, later):
        task = PLACE(params(objects={earlier: (3, 4), later: (3, 4)}))
        assert np.flatnonzero(task.present).tolist() == [earlier]

    def test_a_refused_object_keeps_a_later_one_off_only_that_tile(self):
        task = PLACE(params(objects={GOAL: (3, 4), YELLOW_DOOR: (3, 4), YELLOW_KEY: (3, 5)}))
        assert np.flatnonzero(task.present).tolist() == [GOAL, YELLOW_KEY]

    @pytest.mark.parametrize("index", [YELLOW_DOOR, BLUE_DOOR, YELLOW_KEY, BLUE_KEY])
    def test_no_door_or_key_on_the_start_tile(self, index):
        assert not PLACE(params(objects={index: (1, 1)})).present.any()

    def test_a_goal_may_stand_on_the_start_tile(self):
        task = PLACE(params(objects={GOAL: (1, 1)}))
        assert task.present.tolist() == [True, False, False, False, False]
        assert format_layout(task).startswith("G")

    @pytest.mark.parametrize("category", [WALL, LAVA])
    def test_the_start_tile_is_floor(self, category):
        assert PLACE(params(tiles={(1, 1): category})).tiles[1, 1] == EMPTY

    def test_a_door_stays_closed_if_its_key_would_stand_on_the_start_tile(self):
        (out,) = play(PLACE(params(objects={YELLOW_DOOR: (1, 2), YELLOW_KEY: (1, 1)})), [RIGHT])
        assert_step(out, position=(1, 1), reward=-0.501, terminated=True)

    @pytest.mark.parametrize(("coordinate", "tile"), [(1.0, 1), (1.999, 1), (2.0, 2), (8.999, 8)])
    def test_a_coordinate_belongs_to_the_tile_it_lies_in(self, coordinate, tile):
        w = params()
        task = PLACE(w | {"xy": w["xy"].at[:2].set(coordinate)})
        assert task.objects[GOAL].tolist() == [tile, tile]

    @pytest.mark.parametrize("coordinate", [0.0, 0.999, 9.0, 10.0])
    def test_the_outermost_coordinates_are_the_border(self, coordinate):
        w = params()
        assert not PLACE(w | {"xy": w["xy"].at[:2].set(coordinate)}).present.any()

    def test_uniform_params_hit_every_tile_and_category_equally_often(self):
        w = jax.device_get(jax.jit(jax.vmap(SPACE.sample_uniform))(jax.random.split(jax.random.key(0), 4_000)))
        tiles = np.floor(w["xy"]).astype(int)
        assert np.bincount(tiles.ravel(), minlength=10) == pytest.approx(np.full(10, 4_000), rel=0.06)
        categories = w["tiles"].argmax(axis=-1)
        assert np.bincount(categories.ravel(), minlength=3) == pytest.approx(np.full(3, 4_000 * 64 / 3), rel=0.01)

    def test_sampled_params_have_the_shapes_of_the_spec(self):
        assert jax.eval_shape(SPACE.sample_uniform, jax.random.key(0)) == param_struct(SPACE.param_spec)

    def test_a_wrong_shape_is_refused(self):
        w = params()
        with pytest.raises(AssertionError, match="shape"):
            SPACE.instantiate(w | {"xy": w["xy"][:8]})


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


def load_all():
    return {name: envs.load_target("grid_world", name) for name in SPACE.targets}


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


def test_actions_are_the_four_moves():
    assert SPACE.num_actions == len(MOVES) == 4


def test_tiles_of_stacked_tasks():
    """Regression: without a leading `...` the slice cut tasks, not tiles, off a batch."""
    tasks = load_all()
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *tasks.values())
    for index, task in enumerate(tasks.values()):
        np.testing.assert_array_equal(stacked.tiles[index], task.tiles)


def test_one_trace_serves_all_tasks():
    traces = []

    @jax.jit
    def step(state, action, task):
        traces.append(None)
        return SPACE.step(state, action, task)

    for task in [*load_all().values(), PLACE(params())]:
        state, _ = SPACE.reset(jax.random.key(0), task)
        for action in range(4):
            state = step(state, jnp.int32(action), task).state
    assert len(traces) == 1
