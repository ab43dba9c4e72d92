"""Restore rule, schedules and one update of the learner."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax import learner
from apt_jax.config import HParams
from apt_jax.networks import QNetwork
from apt_jax.replay import Batch
from apt_jax.specs import Vector

NETWORK = QNetwork({"x": Vector(3, -1, 1)}, 4)


def _marked(value):
    """A learner state recognisable by its parameters."""
    return learner.LearnerState({"p": jnp.float32(value)}, {"p": jnp.float32(value)}, {"m": jnp.float32(value)})


def _restores(scores):
    """Which evaluations of a run with these scores restore, and the accepted score after each."""
    state = _marked(0)
    kept = learner.Kept(state, jnp.float32(jnp.nan))
    restored, accepted = [], []
    for i, score in enumerate(scores, start=1):
        state, kept, drop = learner.keep_or_restore(_marked(i), kept, jnp.float32(score))
        restored.append(bool(drop))
        accepted.append(float(kept.score))
        assert state == kept.learner, "online, target and optimiser state go back together"
        assert float(state.params["p"]) == float(state.opt_state["m"])
        assert drop == (float(state.params["p"]) != i)
    return restored, accepted


def test_restore_rule_oracle():
    restored, accepted = _restores([-0.1, 0.2, 0.8, 0.3, 0.5, 0.9])
    assert restored == [False, False, False, True, True, False]
    np.testing.assert_allclose(accepted, [-0.1, 0.2, 0.8, 0.8, 0.8, 0.9], rtol=1e-6)


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([-0.5, -0.8], [False, False]),
        ([0.0, -0.8], [False, False]),
        ([float("nan"), -0.5, 0.3], [False, False, False]),
        ([0.5, float("nan")], [False, True]),
    ],
)
def test_restore_rule_at_its_edges(scores, expected):
    assert _restores(scores)[0] == expected


def test_equality_is_no_drop():
    new = _marked(2)
    state, _, drop = learner.keep_or_restore(new, learner.Kept(_marked(1), jnp.float32(0.5)), jnp.float32(0.5))
    assert not drop
    assert state == new


@pytest.mark.parametrize(
    ("score", "reset_every", "expected"),
    [
        (-0.1, 300.0, [300, 600, 900]),
        (0.0, 250.0, [300, 500, 800, 1000]),
        (float("nan"), 50.0, list(range(100, 1100, 100))),
        (0.1, 300.0, []),
        (-0.1, float("inf"), []),
    ],
)
def test_the_q_function_starts_anew_while_nothing_is_reached(score, reset_every, expected):
    old = learner.init(NETWORK, jax.random.key(0))
    old = old._replace(target_params=jax.tree.map(lambda x: x + 1, old.params))
    kept = learner.Kept(old, jnp.float32(score))
    hparams, resets = HParams(reset_every=reset_every), []
    for steps in range(100, 1100, 100):
        key = jax.random.key(steps)
        state, reset = learner.reset(NETWORK, old, kept, key, steps=jnp.int32(steps), every=100, hparams=hparams)
        chex.assert_trees_all_equal(state, learner.init(NETWORK, jax.random.clone(key)) if reset else old)
        resets += [steps] * bool(reset)
    assert resets == expected


def test_epsilon_falls_linearly_then_stays():
    hparams = HParams(epsilon_start=1.0, epsilon_end=0.1, epsilon_steps=1000.0)
    steps = [-500, 0, 500, 1000, 99_000]
    values = [learner.epsilon_schedule(jnp.int32(n), hparams) for n in steps]
    np.testing.assert_allclose(values, [1.0, 1.0, 0.55, 0.1, 0.1], rtol=1e-6)


def test_epsilon_greedy_explores_uniformly_in_its_share():
    params = learner.init(NETWORK, jax.random.key(0)).params
    obs = {"x": jnp.broadcast_to(jnp.array([0.3, -0.2, 0.9]), (20_000, 3))}
    greedy = learner.greedy(NETWORK, params, obs)
    action = learner.epsilon_greedy(NETWORK, params, obs, jax.random.key(1), 0.4)
    counts = np.bincount(np.asarray(action), minlength=4) / 20_000
    expected = np.full(4, 0.1)
    expected[int(greedy[0])] += 0.6
    np.testing.assert_allclose(counts, expected, atol=0.015)
    np.testing.assert_array_equal(learner.epsilon_greedy(NETWORK, params, obs, jax.random.key(1), 0.0), greedy)


def _batch(key, reward):
    obs = {"x": jax.random.uniform(key, (64, 3), minval=-1.0)}
    return Batch(obs, jnp.arange(64) % 4, reward, obs, jnp.zeros(64))


def test_updates_fit_terminal_rewards_and_move_the_target_network_slowly():
    state = learner.init(NETWORK, jax.random.key(0))
    batch = _batch(jax.random.key(1), reward=jnp.float32(jnp.arange(64) % 4) * 0.25)
    hparams = HParams(learning_rate=1e-2, target_rate=0.01)

    @jax.jit
    def update(state):
        return learner.update(NETWORK, state, batch, low=jnp.float32(-1), high=jnp.float32(1), hparams=hparams)

    once, _ = update(state)
    for target, new, old in zip(*map(jax.tree.leaves, (once.target_params, once.params, state.params)), strict=True):
        np.testing.assert_allclose(target - old, 0.01 * (new - old), atol=1e-6)
    first = update(state)[1]["td_loss"]
    for _ in range(300):
        state, metrics = update(state)
    assert metrics["td_loss"] < 0.01 * first
    np.testing.assert_allclose(NETWORK.apply(state.params, batch.obs).mean(0), [0.0, 0.25, 0.5, 0.75], atol=0.05)
