"""What holds in Grid-World for every parameter and every sequence of actions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from apt_jax.specs import obs_struct
from envs.grid_world import Space
from envs.grid_world.board import DOORS, EMPTY, GOAL, KEYS, WALL
from envs.grid_world.layout import format_layout, parse_layout

SPACE = Space()
HORIZON = SPACE.horizon

categories = arrays(np.int8, (8, 8), elements=st.integers(0, 2), fill=st.just(0))
coordinates = arrays(np.float32, 10, elements=st.floats(0, 10, width=32))
plans = arrays(np.int32, HORIZON, elements=st.integers(0, 3))
params = st.builds(lambda tiles, xy: {"tiles": np.eye(3, dtype=np.float32)[tiles], "xy": xy}, categories, coordinates)

instantiate = jax.jit(SPACE.instantiate)
describe = jax.jit(SPACE.describe)
step = jax.jit(SPACE.step)


@jax.jit
def rollout(w, actions):
    """A task, its first observation and the outputs of HORIZON steps, which go on after the end of an episode."""
    task = SPACE.instantiate(w)
    start, obs = SPACE.reset(jax.random.key(0), task)

    def advance(state, action):
        out = SPACE.step(state, action, task)
        return out.state, out

    return task, obs, jax.lax.scan(advance, start, actions)[1]


def episode(w, actions):
    """Like `rollout`, fetched, with the outputs cut off at the end of the episode."""
    task, obs, outs = jax.device_get(rollout(w, actions))
    length = int(np.argmax(outs.terminated | outs.truncated)) + 1
    assert (outs.terminated | outs.truncated)[length - 1], "an episode ends by the horizon"
    return task, obs, jax.tree.map(lambda leaf: leaf[:length], outs)


@given(params, plans)
def test_the_agent_stands_on_floor(w, actions):
    task, _, outs = episode(w, actions)
    rows, columns = outs.state.position.T
    assert (task.tiles[rows, columns] == EMPTY).all()
    for position, keys in zip(outs.state.position, outs.state.keys, strict=True):
        closed = task.objects[DOORS][task.present[DOORS] & ~keys]
        assert position.tolist() not in closed.tolist()


@given(params, plans)
def test_episodes_end_once_and_by_the_horizon(w, actions):
    _, _, outs = episode(w, actions)
    length = len(outs.reward)
    assert not (outs.terminated & outs.truncated).any()
    assert outs.truncated.any() == (length == HORIZON and not outs.terminated[-1])
    assert (outs.success <= outs.terminated).all()
    np.testing.assert_array_equal(outs.state.steps, np.arange(1, length + 1))


@given(params, plans)
def test_rewards_are_of_five_kinds(w, actions):
    _, _, outs = episode(w, actions)
    assert np.isin(outs.reward, np.array([-0.001, -0.002, -0.501, 0.999, -1.0], np.float32)).all()
    assert ((outs.reward > 0) == outs.success).all()
    assert ((outs.reward < -0.5) == (outs.terminated & ~outs.success)).all()


@given(params, plans)
def test_observations_are_consistent_with_the_board(w, actions):
    task, first, outs = episode(w, actions)
    walled = np.pad(task.tiles, 3, constant_values=WALL)
    steps = [first, *(jax.tree.map(lambda leaf, t=t: leaf[t], outs.obs) for t in range(len(outs.reward)))]
    keys = [np.zeros(2, bool), *outs.state.keys]
    for obs, taken in zip(steps, keys, strict=True):
        row, column = obs["agent"].astype(int)
        np.testing.assert_array_equal(obs["view"], walled[row : row + 7, column : column + 7])
        places = obs["objects"].reshape(5, 2) + np.array([row, column])
        shown = task.present & ~np.array([False, *taken, *taken])
        np.testing.assert_array_equal(places[shown], task.objects[shown])
        assert (places[~shown] == [row, column]).all()
    np.testing.assert_array_equal(outs.obs["agent"], outs.state.position)


@given(params, plans)
def test_values_lie_in_the_ranges_of_the_spec(w, actions):
    _, first, outs = episode(w, actions)
    assert jax.eval_shape(lambda: first) == obs_struct(SPACE.obs_spec)
    for name in ("agent", "objects"):
        modality = SPACE.obs_spec[name]
        assert outs.obs[name].min() >= modality.low
        assert outs.obs[name].max() <= modality.high
    assert outs.obs["view"].max() < SPACE.obs_spec["view"].categories
    assert np.isfinite(outs.reward).all()


@given(params)
def test_objects_stand_apart_on_interior_floor(w):
    task = jax.device_get(instantiate(w))
    places = task.objects[task.present]
    assert len({tuple(place) for place in places.tolist()}) == len(places)
    assert ((places >= 1) & (places <= 8)).all()
    assert (task.tiles[tuple(places.T)] == EMPTY).all()
    assert (task.objects[~task.present] == 0).all()
    assert (task.tiles[[0, -1]] == WALL).all()
    assert (task.tiles[:, [0, -1]] == WALL).all()


@given(params)
def test_layouts_read_back(w):
    task = instantiate(w)
    text = format_layout(task)
    if text.startswith("A") and task.present[GOAL]:
        jax.tree.map(np.testing.assert_array_equal, parse_layout(text), task)


@given(params)
def test_descriptions_are_in_range(w):
    described = jax.device_get(describe(instantiate(w), instantiate(w)))
    assert described["feasible"] == np.isfinite(described["solution_length"])
    assert not described["solution_length"] < 1
    assert not described["solution_length"] > HORIZON
    assert 0 <= described["walls"] + described["lava"] <= 63 / 64  # the start tile is floor


@given(plans)
def test_a_key_once_taken_stays_taken(actions):
    task = parse_layout("Ay......\nb.......\n" + "........\n" * 5 + ".......G")
    start, _ = SPACE.reset(jax.random.key(0), task)
    state, taken = start, np.zeros(2, bool)
    key_places = np.asarray(task.objects[KEYS])
    for action in actions[:10]:
        state = step(state, jnp.asarray(action), task).state
        taken |= (np.asarray(state.position) == key_places).all(axis=-1)
        np.testing.assert_array_equal(state.keys, taken)


def test_states_are_told_apart_by_place_and_keys_held():
    task = parse_layout("Ay......\nb.......\n" + "........\n" * 5 + ".......G")
    start, _ = SPACE.reset(jax.random.key(0), task)
    right, left = jnp.int32(1), jnp.int32(3)
    taken = step(start, right, task).state
    back = step(taken, left, task).state
    here, there = np.asarray(SPACE.fingerprint(start)), np.asarray(SPACE.fingerprint(back))
    assert (here[:2] == there[:2]).all(), "the same place"
    assert (here[2:] != there[2:]).sum() == 1, "with one key more"
    assert (np.asarray(SPACE.fingerprint(taken))[:2] != here[:2]).any()
