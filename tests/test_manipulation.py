"""The rules of Manipulation: what a parameter yields, what the agent sees, rewards and ends."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax.specs import obs_struct, param_struct
from envs.manipulation.dynamics import GOAL_RADIUS, progress
from envs.manipulation.placement import GOAL, PARAM_SPEC
from envs.manipulation.table import landscape
from tests.tables import AWAY, BLUE, FLAT, GREEN, GREY, LEFT, NEAR, PIT, RIGHT, ROADBLOCK, SPACE, params, play, table

PLACE = jax.jit(SPACE.instantiate)


class TestParameters:
    def test_there_are_31_variables(self):
        w = {name: struct.shape for name, struct in param_struct(SPACE.param_spec).items()}
        assert w == {"blocks": (6, 4, 3), "placement": (3, 24), "offset": (6,), "goal_range": (1,)}

    @pytest.mark.parametrize(("category", "height"), [(FLAT, 0.0), (PIT, -0.05), (ROADBLOCK, 0.10)])
    @pytest.mark.parametrize("block", [(0, 0), (5, 3), (2, 1)])
    def test_a_block_is_where_its_index_says(self, block, category, height):
        task = PLACE(params(blocks={block: category}))
        corner = 0.15 * np.array(block)
        inside = corner + np.array([[0.01, 0.01], [0.075, 0.075], [0.14, 0.14], [0.14, 0.01]])
        np.testing.assert_allclose(landscape(task, jnp.asarray(inside, jnp.float32)), height, atol=1e-7)
        centers = 0.15 * (np.argwhere(np.ones((6, 4))) + 0.5)
        others = centers[~np.all(np.isclose(centers, corner + 0.075), axis=-1)]
        np.testing.assert_array_equal(landscape(task, jnp.asarray(others, jnp.float32)), 0)

    def test_cans_stand_on_their_blocks_with_their_offsets(self):
        offset = [0.02, -0.02, 0.01, 0.0, -0.01, 0.015]
        task = PLACE(params(cans={0: (0, 0), 1: (5, 1), 2: (2, 3)}, offset=offset))
        assert task.present.all()
        np.testing.assert_allclose(task.cans, [[0.095, 0.055], [0.835, 0.225], [0.365, 0.54]], atol=1e-6)

    def test_a_can_on_a_block_that_is_not_flat_or_taken_does_not_appear(self):
        blocks = {(1, 1): PIT, (4, 2): ROADBLOCK}
        placed = {
            (True, True, True): {0: (0, 0), 1: (2, 0), 2: (3, 0)},
            (False, True, True): {0: (1, 1), 1: (2, 0), 2: (3, 0)},
            (True, False, True): {0: (0, 0), 1: (4, 2), 2: (3, 0)},
            (True, False, False): {0: (0, 0), 1: (0, 0), 2: (0, 0)},
            (True, True, False): {0: (0, 0), 1: (2, 0), 2: (2, 0)},
            (False, False, True): {0: (1, 1), 1: (1, 1), 2: (5, 3)},
            (True, False, True): {0: (0, 0), 1: (0, 0), 2: (3, 0)},  # noqa: F601
        }
        for present, cans in placed.items():
            task = PLACE(params(blocks=blocks, cans=cans))
            assert tuple(task.present.tolist()) == present
            assert (np.asarray(task.cans)[~np.array(present)] == -1).all()

    def test_the_goal_is_no_parameter_but_its_range_is(self):
        task = PLACE(params(reach=0.45))
        np.testing.assert_allclose(task.goal, GOAL)
        assert task.goal_range == np.float32(0.45)

    def test_uniform_parameters_are_in_range_and_spread(self):
        w = jax.jit(jax.vmap(SPACE.sample_uniform))(jax.random.split(jax.random.key(0), 500))
        assert jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), w) == param_struct(SPACE.param_spec)
        for name in ("offset", "goal_range"):
            low, high = PARAM_SPEC[name].low, PARAM_SPEC[name].high
            assert w[name].min() >= low
            assert w[name].max() <= high
            np.testing.assert_allclose(w[name].mean(axis=0), (low + high) / 2, atol=0.1 * (high - low))
        shares = np.bincount(np.argmax(w["blocks"], axis=-1).ravel(), minlength=3) / (500 * 24)
        np.testing.assert_allclose(shares, 1 / 3, atol=0.03)
        assert (np.bincount(np.argmax(w["placement"], axis=-1).ravel(), minlength=24) > 20).all()


class TestObservation:
    def test_places_of_cans_and_goal(self):
        task = table((20, 10), (50, 40))
        state, obs = SPACE.reset(jax.random.key(3), task)
        assert jax.eval_shape(lambda: obs) == obs_struct(SPACE.obs_spec)
        np.testing.assert_allclose(obs["positions"][:6], [0.2, 0.1, 0.5, 0.4, -1, -1], atol=1e-6)
        np.testing.assert_array_equal(obs["positions"][6:], state.goal)

    def test_heights_ten_centimetres_from_each_can(self):
        """Right, away from the robot, left, towards the robot."""
        task = table((22, 22), (85, 22), rows="F.FFFF\nFF#FFF\nFFFFFF\nFFFFFF")
        _, obs = SPACE.reset(jax.random.key(0), task)
        heights = obs["landscape"].reshape(3, 4)
        np.testing.assert_allclose(heights[BLUE], [0.10, 0, 0, -0.05], atol=1e-7)
        np.testing.assert_allclose(heights[GREEN], [-0.05, 0, 0, 0], atol=1e-7)
        np.testing.assert_array_equal(heights[GREY], 0)

    def test_a_higher_obstacle_looks_like_a_roadblock(self):
        _, obs = SPACE.reset(jax.random.key(0), table((20, 20), extra="cylinder 30 20 5 30"))
        np.testing.assert_allclose(obs["landscape"][0], 0.10)

    def test_the_goal_is_drawn_about_the_tasks_for_every_episode(self):
        task = table((20, 10))
        goals = np.array([SPACE.reset(jax.random.key(seed), task)[0].goal for seed in range(60)])
        off = goals - np.array(GOAL)
        assert np.abs(off).max() <= 0.03
        assert off.max(axis=0).min() > 0.02
        assert off.min(axis=0).max() < -0.02
        fixed = type(SPACE)(goal_jitter=0.0)
        np.testing.assert_allclose(fixed.reset(jax.random.key(1), task)[0].goal, GOAL, atol=1e-7)


def ends(out):
    return bool(out.terminated), bool(out.truncated), bool(out.success)


class TestRewards:
    def test_reaching_the_goal_pays_one(self):
        """No progress: r2 is r1."""
        out = play(table((52, 21)), [(BLUE, RIGHT)])[-1]
        assert out.reward == 1
        assert ends(out) == (True, False, True)

    def test_the_goal_is_reached_within_ten_centimetres(self):
        task = table((40, 21))
        stop = float(play(task, [(BLUE, RIGHT)])[-1].state.cans[BLUE, 0])
        for gap, success in ((GOAL_RADIUS - 0.001, True), (GOAL_RADIUS + 0.001, False)):
            out = play(task, [(BLUE, RIGHT)], goal=(stop + gap, 0.21))[-1]
            assert bool(out.success) == success
            assert out.reward == float(success)

    def test_a_target_that_starts_in_the_goal_succeeds_with_the_first_push_of_any_can(self):
        out = play(table((70, 21), (20, 20)), [(GREEN, RIGHT)])[-1]
        assert out.reward == 1
        assert out.success

    def test_other_cans_in_the_goal_are_no_success(self):
        out = play(table((20, 50), (52, 21)), [(GREEN, RIGHT)])[-1]
        assert out.reward == 0
        assert ends(out) == (False, False, False)

    def test_progress_is_paid_by_the_metre(self):
        """r2 = 50 cm, hence 40 cm of way: a push towards the goal pays its length over that, one back takes it again."""
        task = table((32, 21), reach=50)
        outs = play(task, [(BLUE, RIGHT), (BLUE, LEFT), (GREEN, RIGHT)])
        moved = float(outs[0].state.cans[BLUE, 0]) - 0.32
        assert moved > 0.1
        np.testing.assert_allclose(outs[0].reward, moved / 0.4, atol=1e-5)
        back = float(outs[1].state.cans[BLUE, 0]) - 0.32 - moved
        np.testing.assert_allclose(outs[1].reward, back / 0.4, atol=1e-5)
        assert outs[2].reward == 0

    def test_states_are_told_apart_by_where_the_cans_are(self):
        out, back, idle = play(table((20, 21), (60, 51)), [(BLUE, RIGHT), (BLUE, LEFT), (GREY, RIGHT)])
        here, there, still = (SPACE.fingerprint(step.state) for step in (out, back, idle))
        assert here.dtype == jnp.int32
        assert np.flatnonzero(here != there).tolist() == [0], "the blue can has moved along x"
        np.testing.assert_array_equal(there, still)
        np.testing.assert_array_equal(here[2:4], [60, 51])

    def test_success_pays_the_last_progress_too(self):
        out = play(table((52, 21), reach=50), [(BLUE, RIGHT)])[-1]
        np.testing.assert_allclose(out.reward, 1 + 0.08 / 0.4, atol=1e-5)

    def test_nothing_is_paid_outside_r2(self):
        assert play(table((12, 21), reach=40), [(BLUE, RIGHT)])[-1].reward == 0

    def test_progress_by_hand(self):
        def paid(distance, reach):
            return float(progress(jnp.float32(distance), jnp.float32(reach)))

        assert paid(0.05, 0.10) == paid(0.10, 0.10) == paid(0.15, 0.10) == 0
        np.testing.assert_allclose([paid(0.6, 0.6), paid(0.35, 0.6), paid(0.1, 0.6), paid(0.0, 0.6)], [0, 0.5, 1, 1], atol=1e-6)
        # Below r2 = r1 + 10 cm the way is worth 10 per metre, so that less and less is paid as r2 comes close to r1.
        np.testing.assert_allclose([paid(0.1, 0.2), paid(0.1, 0.15), paid(0.1, 0.101)], [1, 0.5, 0.01], atol=1e-5)

    @pytest.mark.parametrize("can", [BLUE, GREEN])
    def test_a_fall_costs_a_fifth(self, can):
        places = [(20, 50), (20, 20)]
        places[can] = (85, 40)
        out = play(table(*places, reach=60), [(can, RIGHT)])[-1]
        assert out.reward == np.float32(-0.2)
        assert ends(out) == (True, False, False)

    def test_a_pit_is_a_fall(self):
        out = play(table((22, 22), rows="FFFFFF\nFF.FFF\nFFFFFF\nFFFFFF"), [(BLUE, RIGHT)])[-1]
        assert out.reward == np.float32(-0.2)
        assert out.terminated

    def test_a_hit_costs_a_tenth(self):
        roadblock = play(table((22, 22), rows="FFFFFF\nFF#FFF\nFFFFFF\nFFFFFF"), [(BLUE, RIGHT)])[-1]
        can = play(table((22, 22), (38, 22), reach=60), [(BLUE, RIGHT)])[-1]
        other = play(table((22, 22), (38, 22)), [(GREEN, LEFT)])[-1]
        for out in (roadblock, can, other):
            assert out.reward == np.float32(-0.1)
            assert ends(out) == (True, False, False)

    def test_a_hit_in_the_goal_is_no_success(self):
        out = play(table((58, 21), (72, 21)), [(BLUE, RIGHT)])[-1]
        assert out.reward == np.float32(-0.1)
        assert ends(out) == (True, False, False)

    def test_pushing_what_is_not_there_costs_a_step_and_nothing_else(self):
        out = play(table((20, 20)), [(GREY, AWAY)])[-1]
        assert out.reward == 0
        assert ends(out) == (False, False, False)
        assert out.state.steps == 1
        np.testing.assert_array_equal(out.state.cans[GREY], -1)

    def test_without_a_target_nothing_is_paid(self):
        task = PLACE(params(blocks={(1, 1): PIT}, cans={0: (1, 1), 1: (2, 2)}, reach=0.6))
        outs = play(task, [(BLUE, RIGHT), (GREEN, RIGHT)])
        assert [float(out.reward) for out in outs] == [0, 0]
        assert not any(out.terminated for out in outs)

    def test_the_horizon_truncates(self):
        outs = play(table((45, 52)), [(BLUE, RIGHT), (BLUE, LEFT)] * 7 + [(BLUE, NEAR)])
        assert len(outs) == 15
        assert [ends(out) for out in outs] == [(False, False, False)] * 14 + [(False, True, False)]

    def test_success_with_the_last_push_is_no_truncation(self):
        outs = play(table((52, 21), (20, 50)), [(GREEN, RIGHT), (GREEN, LEFT)] * 7 + [(BLUE, RIGHT)])
        assert ends(outs[-1]) == (True, False, True)
