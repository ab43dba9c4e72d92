"""ALP-GMM and GoalGAN: oracles, and where their proposals go when the best region is known."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import envs
from apt_jax import losses
from apt_jax import replay as rp
from apt_jax.config import Config, HParams
from apt_jax.curricula import CURRICULA, alp_gmm, goal_gan
from apt_jax.curricula.base import GENERATED
from apt_jax.specs import Grid, Table, Vector, block_weights, flatten, unflatten
from experiments.examples.corridor import Corridor

SPEC = {"tiles": Grid(2, 2, 3), "xy": Vector(2, 0, 10), "place": Table(2, 4)}


learning_progress = jax.jit(alp_gmm.learning_progress, static_argnames="window")


def progress(w, returns, window=None):
    """`learning_progress` of episodes given oldest first, as is its result."""
    window = window or len(returns)
    history = len(returns)
    w, r = (np.asarray(x, np.float32)[::-1] for x in (w, returns))
    w, r = np.pad(w, [(0, history), (0, 0)]), np.pad(r, (0, history))
    earlier = history - 1 - np.arange(len(w), dtype=np.int32)
    return np.asarray(learning_progress(w, r, earlier, window=window))[::-1]


def brute_force(w, returns, history=None):
    """Learning progress by its definition, oldest first; compared with the `history` episodes before, by default all."""
    w, values = np.asarray(w, np.float32), []
    for i in range(len(w)):
        first = 0 if history is None else max(i - history, 0)
        distance = np.array([np.sum((w[j] - w[i]) ** 2, dtype=np.float32) for j in range(first, i)])
        if i <= 5:
            values.append(0.0)
        else:
            newest = first + max(np.flatnonzero(distance == distance.min()))
            values.append(abs(returns[i] - returns[newest]))
    return values


def test_learning_progress_oracle():
    w = [[0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0.5], [0.2, 0.8], [0.9, 0.1], [0.15, 0.85], [0.5, 0.4], [0.9, 0.12]]
    returns = [0, 0.1, 0.2, 0.3, 0.4, 0.5, 1, 0, -0.5, 0.25]
    np.testing.assert_allclose(progress(w, returns), [0] * 6 + [0.9, 0.5, 0.9, 0.75], rtol=1e-5)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(-4, 4)), min_size=12, max_size=12))
def test_learning_progress_equals_its_definition(episodes):
    """On a coarse lattice, where many tasks are equally near."""
    w = [episode[:2] for episode in episodes]
    returns = [episode[2] / 4 for episode in episodes]
    np.testing.assert_allclose(progress(w, returns), brute_force(w, returns), atol=1e-6)
    newest, earlier = (np.asarray(x, np.float32)[::-1] for x in (w, returns))
    short = np.asarray(learning_progress(newest, earlier, 11 - np.arange(12, dtype=np.int32), window=8))
    np.testing.assert_allclose(short[::-1], brute_force(w, returns, history=4)[4:], atol=1e-6)


def test_components_are_drawn_by_their_progress():
    share = jax.nn.softmax(alp_gmm.component_logits(jnp.array([0.1, 0.3, 0.0, 9.0]), jnp.int32(3)))
    np.testing.assert_allclose(share, [0.25, 0.75, 0.0, 0.0], atol=1e-6)
    none = jax.nn.softmax(alp_gmm.component_logits(jnp.array([0.0, -0.1, 0.0]), jnp.int32(2)))
    np.testing.assert_allclose(none, [0.5, 0.5, 0.0], atol=1e-6)


def test_flattening_is_undone_and_blocks_weigh_alike():
    scores = {"tiles": (5, 2, 2, 3), "place": (5, 2, 4)}
    w = {name: jax.random.uniform(jax.random.key(len(shape)), shape) for name, shape in scores.items()}
    w["xy"] = jnp.full((5, 2), 7.5)
    vector = flatten(SPEC, w)
    np.testing.assert_allclose(vector[:, 12:14], 0.75)
    for name, block in unflatten(SPEC, vector).items():
        np.testing.assert_allclose(block, w[name], rtol=1e-6)
    weights = block_weights(SPEC)
    np.testing.assert_allclose([np.sum(block**2) for block in np.split(weights, [12, 14])], 1.0, rtol=1e-6)


def test_vectors_out_of_range_keep_their_categories():
    """Clipping each score first would favour the first category, .412 to .268."""
    vector = 0.5 + jax.random.normal(jax.random.key(1), (30_000, 22))
    w = unflatten(SPEC, vector)
    for name, scores in (("tiles", vector[:, :12].reshape(-1, 2, 2, 3)), ("place", vector[:, 14:].reshape(-1, 2, 4))):
        wanted = jnp.argmax(scores, axis=-1)
        np.testing.assert_array_equal(jnp.argmax(w[name], axis=-1), wanted)
        np.testing.assert_allclose(np.bincount(np.ravel(wanted)) / wanted.size, 1 / scores.shape[-1], atol=0.005)
    for name, high in (("tiles", 1.0), ("place", 1.0), ("xy", 10.0)):
        assert w[name].min() >= 0
        assert w[name].max() <= high
    np.testing.assert_array_equal(w["xy"], 10.0 * jnp.clip(vector[:, 12:14], 0.0, 1.0))


def test_random_tasks_are_uniform():
    space = envs.make("grid_world")
    curriculum = CURRICULA["random"](space, Config())
    w = curriculum.propose((), jax.random.key(0), 2_000, HParams())
    categories = np.bincount(np.ravel(np.argmax(w["tiles"], axis=-1)), minlength=3)
    assert stats.chisquare(categories).pvalue > 1e-3
    assert stats.kstest(np.ravel(w["xy"]) / 10, "uniform").pvalue > 1e-3


def test_lsgan_oracle():
    label, score = jnp.array([1.0, 0.0, 1.0, 0.0]), jnp.array([0.5, -0.2, 1.0, 0.3])
    generated = jnp.array([0.1, -0.7, 0.4, 0.0])
    np.testing.assert_allclose(losses.lsgan_discriminator_loss(label, score, generated), 0.855, rtol=1e-6)
    np.testing.assert_allclose(losses.lsgan_generator_loss(generated), 1.265, rtol=1e-6)
    np.testing.assert_allclose(losses.lsgan_generator_loss(generated, wanted=0.0), 0.165, rtol=1e-6)


def test_a_task_is_judged_by_all_its_episodes_once():
    tasks = jnp.array([[1.0], [2.0], [1.0], [3.0], [2.0], [0.0]])
    success = jnp.array([True, False, False, True, False, True])
    valid = jnp.array([True] * 5 + [False])
    rate, judged = goal_gan.success_rates(tasks, success, valid, rollouts=2)
    np.testing.assert_array_equal(judged, [True, True, False, False, False, False])
    np.testing.assert_allclose(rate[:2], [0.5, 0.0])


def test_memory_replaces_its_oldest_tasks():
    memory = goal_gan.Memory(jnp.zeros((2, 1)), jnp.int32(0))
    memory = goal_gan.remember(memory, jnp.array([[1.0], [2.0], [3.0]]), jnp.array([True, False, True]))
    np.testing.assert_array_equal(memory.tasks, [[1.0], [3.0]])
    memory = goal_gan.remember(memory, jnp.array([[4.0]]), jnp.array([True]))
    np.testing.assert_array_equal(memory.tasks, [[4.0], [3.0]])


class Plane:
    """Only what a curriculum needs of a task space: two numbers."""

    name = "plane"
    param_spec = {"at": Vector(2, 0, 1)}  # noqa: RUF012

    def sample_uniform(self, key):
        return {"at": jax.random.uniform(key, (2,))}


CONFIG = Config(
    warmup_steps=100,
    model_batch_size=64,
    noise_size=4,
    replay_episodes=600,
    alp_window=100,
    alp_history=300,
    alp_fit_every=100,
    refresh_every=100,
    goal_tasks=50,
)


def teach(curriculum, outcome, rounds, key):
    """Tasks proposed after `rounds` of 50 proposals, each played `curriculum.rollouts` times.

    `outcome(at, time, key)` is (return, success) of tasks [50, 2] at a time in [0, 1].
    """
    hparams = HParams()
    rings = rp.init(Plane.param_spec, Plane.param_spec, sources=2, envs=1, columns=1, episodes=CONFIG.replay_episodes)
    key_init, key_rounds, key_last = jax.random.split(key, 3)
    state = curriculum.init(key_init, hparams)

    def play(rings, w, time, key):
        episode_return, success = outcome(w["at"], time, key)
        slot = (rings.finished[GENERATED] + jnp.arange(50, dtype=jnp.int32)) % CONFIG.replay_episodes
        episodes = rings.episodes._replace(
            w={"at": rings.episodes.w["at"].at[GENERATED, slot].set(w["at"])},
            episode_return=rings.episodes.episode_return.at[GENERATED, slot].set(episode_return),
            success=rings.episodes.success.at[GENERATED, slot].set(success),
        )
        return rings._replace(episodes=episodes, finished=rings.finished.at[GENERATED].add(50))

    def round_(carry, i):
        state, rings, key = carry
        key, key_propose, key_play, key_refresh, key_update = jax.random.split(key, 5)
        w = curriculum.propose(state, key_propose, 50, hparams)
        for key_rollout in jax.random.split(key_play, curriculum.rollouts):
            rings = play(rings, w, i / rounds, key_rollout)
        steps = jnp.int32(100 + 100 * (i + 1)) // 2
        state = curriculum.refresh(state, key_refresh, rings, steps, hparams)

        def update(carry, _):
            state, key = carry
            key, key_one = jax.random.split(key)
            return (curriculum.update(state, key_one, rings, steps, hparams)[0], key), None

        (state, _), _ = jax.lax.scan(update, (state, key_update), length=40)
        return (state, rings, key), None

    (state, _, _), _ = jax.lax.scan(round_, (state, rings, key_rounds), jnp.arange(rounds, dtype=jnp.int32))
    return curriculum.propose(state, key_last, 400, hparams)["at"], state


@pytest.mark.relaxed("types")  # a Plane has only what a curriculum needs
def test_alp_gmm_goes_where_returns_change():
    """Returns rise over time in one quarter of the plane and depend on nothing but the place elsewhere."""
    curriculum = alp_gmm.make(Plane(), CONFIG)

    def outcome(at, time, key):
        rising = jnp.all(at > 0.5, axis=1)
        noise = 0.02 * jax.random.normal(key, at.shape[:1])
        return jnp.where(rising, 2.0 * time, 0.5 * at[:, 0]) + noise, rising

    run = jax.jit(lambda keys: jax.lax.map(lambda key: teach(curriculum, outcome, 12, key)[0], keys))
    tasks = run(jax.random.split(jax.random.key(0), 5))
    share = np.mean(np.all(np.asarray(tasks) > 0.5, axis=2), axis=1)
    assert (share > 0.5).all(), share


@pytest.mark.relaxed("types")  # a Plane has only what a curriculum needs
def test_goal_gan_goes_to_tasks_that_succeed_sometimes():
    """Success is certain near the origin and impossible far from it: a band of 23 % of the plane lies between."""
    curriculum = goal_gan.make(Plane(), CONFIG)

    def outcome(at, time, key):
        del time
        chance = jnp.clip((0.7 - jnp.linalg.norm(at, axis=1)) / 0.25, 0.0, 1.0)
        return chance, jax.random.uniform(key, chance.shape) < chance

    run = jax.jit(lambda keys: jax.lax.map(lambda key: teach(curriculum, outcome, 12, key)[0], keys))
    tasks = np.asarray(run(jax.random.split(jax.random.key(0), 5)))
    radius = np.linalg.norm(tasks, axis=2)
    share = np.mean((radius > 0.45) & (radius < 0.7), axis=1)
    assert (share > 0.5).all(), share


@pytest.mark.relaxed("types")  # a Plane has only what a curriculum needs
def test_without_a_good_task_goal_gan_learns_nothing_and_stays_uniform():
    curriculum = goal_gan.make(Plane(), CONFIG)

    def failure(at, time, key):
        del time, key
        return jnp.zeros(at.shape[:1]), jnp.zeros(at.shape[:1], bool)

    tasks, state = jax.jit(lambda key: teach(curriculum, failure, 3, key))(jax.random.key(0))
    assert state.labelled.judged.any()
    before = curriculum.init(jax.random.split(jax.random.key(0), 3)[0], HParams())
    for a, b in zip(jax.tree.leaves(before.networks), jax.tree.leaves(state.networks), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    assert stats.kstest(np.ravel(tasks), "uniform").pvalue > 1e-3


@pytest.mark.parametrize(
    ("curriculum", "changes", "words"),
    [
        ("alp_gmm", {"alp_fit_every": 150}, "alp_fit_every must be a positive multiple of refresh_every=100, got 150"),
        ("alp_gmm", {"alp_window": 301}, "sum to at most replay_episodes=600, got 301 and 300"),
        ("alp_gmm", {"alp_covariance": "diag"}, "alp_covariance must be one of full, diagonal, got 'diag'"),
        ("goal_gan", {"goal_memory": 49}, "goal_tasks=50, got 49"),
        ("goal_gan", {"goal_tasks": 301}, "replay_episodes=600, got 602"),
    ],
)
def test_sizes_that_do_not_fit_are_named(curriculum, changes, words):
    with pytest.raises(ValueError, match=words):
        CURRICULA[curriculum](Corridor(), dataclasses.replace(CONFIG, **changes))
