"""The JAX dynamics against an independent plain-Python implementation, over 100,000 random steps."""

from __future__ import annotations

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.grid_world import Space
from experiments.benchmarks._python_grid_world import PythonGridWorld

TASKS, STEPS = 2000, 50

SPACE = Space()


def random_params(seed: int) -> dict[str, np.ndarray]:
    """Task parameters from sparse to dense, half of them with objects near the start, some on tile edges."""
    rng = np.random.default_rng(seed)
    scores = rng.random((TASKS, 8, 8, 3))
    scores[..., 0] += rng.uniform(0, 1, (TASKS, 1, 1))
    reach = np.where(rng.random((TASKS, 1)) < 0.5, 5.0, 10.0)
    xy = rng.random((TASKS, 10)) * reach
    edges = rng.random((TASKS, 10)) < 0.05
    xy = np.where(edges, np.ceil(xy), xy)  # whole numbers, up to and including 10
    xy[: TASKS // 50, :2] = 1.5  # the goal on the start tile
    return {"tiles": scores.astype(np.float32), "xy": xy.astype(np.float32)}


@pytest.fixture(scope="module")
def trajectories():
    """Everything the JAX version returns, fetched: initial observations, actions, and outputs as [steps, tasks, ...]."""

    @jax.jit
    def collect(params, actions):
        def advance(state, action, task, start):
            out = SPACE.step(state, action, task)
            done = out.terminated | out.truncated
            return jax.tree.map(lambda new, old: jnp.where(done, new, old), start, out.state), out._replace(state=None)

        tasks = jax.vmap(SPACE.instantiate)(params)
        start, obs = jax.vmap(SPACE.reset, in_axes=(None, 0))(jax.random.key(0), tasks)
        _, outs = jax.lax.scan(lambda state, action: jax.vmap(advance)(state, action, tasks, start), start, actions)
        return obs, outs

    params = random_params(seed=0)
    actions = np.random.default_rng(1).integers(0, 4, (STEPS, TASKS))
    # A share of the walks goes right and down in the main, away from the corner, so that far tiles are visited too.
    eager = np.random.default_rng(2).choice([0, 1, 2, 3], p=[0.1, 0.4, 0.4, 0.1], size=actions.shape)
    actions[:, ::2] = eager[:, ::2]
    obs, outs = jax.device_get(collect(params, actions))
    return params, actions, obs, outs


def assert_same_obs(expected, actual):
    assert expected.keys() == actual.keys()
    for name, value in expected.items():
        assert actual[name].tolist() == value, name


def test_every_step_agrees(trajectories):
    params, actions, first_obs, outs = trajectories
    events: Counter[str] = Counter()
    for index in range(TASKS):
        world = PythonGridWorld(params["tiles"][index].tolist(), params["xy"][index].tolist())
        assert_same_obs(world.observation(), {name: value[index] for name, value in first_obs.items()})
        for t in range(STEPS):
            event, reward, terminated, truncated = world.step(int(actions[t, index]))
            events[event] += 1
            events["truncated"] += truncated
            assert_same_obs(world.observation(), {name: value[t, index] for name, value in outs.obs.items()})
            assert outs.reward[t, index] == np.float32(reward), event
            assert outs.terminated[t, index] == terminated, event
            assert outs.truncated[t, index] == truncated, event
            assert outs.success[t, index] == (event == "goal"), event
            if terminated or truncated:
                world.begin()
    assert sum(events.values()) - events["truncated"] == TASKS * STEPS == 100_000
    rare = {
        "started on goal",
        "goal",
        "lava",
        "closed door",
        "key opens door",
        "key without door",
        "through open door",
        "truncated",
    }
    assert {event for event in rare if events[event] < 20} == set(), events


def test_reward_dtype(trajectories):
    *_, outs = trajectories
    assert outs.reward.dtype == np.float32
