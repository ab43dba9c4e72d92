"""Every rule of Grid-World, on small maps and with exact numbers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax.specs import obs_struct, param_struct
from envs.grid_world.dynamics import MOVES
from envs.grid_world.layout import format_layout, parse_layout
from tests.boards import (
    BLUE_DOOR,
    BLUE_KEY,
    DOWN,
    EMPTY,
    GOAL,
    LAVA,
    LEFT,
    PLACE,
    RIGHT,
    SPACE,
    UP,
    WALL,
    YELLOW_DOOR,
    YELLOW_KEY,
    assert_step,
    layout,
    load_all,
    params,
    play,
)


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
