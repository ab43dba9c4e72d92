"""The rings against a plain list of everything that was written."""

from __future__ import annotations

import collections
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax import replay
from apt_jax.specs import Vector

sample_transitions = jax.jit(
    replay.sample_transitions, static_argnames=("batches", "batch_size", "n_step", "success_share", "horizon")
)
sample_rollouts = jax.jit(replay.sample_rollouts, static_argnames=("source", "batch_size", "steps", "recent"))
recent_outcome = jax.jit(replay.recent_outcome, static_argnames=("source", "window", "since"))
write = jax.jit(replay.write)

SOURCES, ENVS, COLUMNS, SLOTS = 2, 3, 16, 8
OBS = {"x": Vector(1, 0, 1000)}
PARAM = {"p": Vector(2, 0, 1000)}


def _code(source, env, iteration):
    """A number that tells where and when an observation was made."""
    return iteration + 100 * env + 10_000 * source


@functools.cache
def _written(iterations, seed=0):
    """A replay written for some iterations with random episode ends, and the list of its finished episodes per source."""
    rng = np.random.default_rng(seed)
    rings = replay.init(OBS, PARAM, sources=SOURCES, envs=ENVS, columns=COLUMNS, episodes=SLOTS)
    length = np.zeros((SOURCES, ENVS), np.int32)
    finished = [[], []]
    source, env = np.meshgrid(np.arange(SOURCES), np.arange(ENVS), indexing="ij")
    for iteration in range(iterations):
        length += 1
        done = rng.random((SOURCES, ENVS)) < 0.3
        code = _code(source, env, iteration)
        transition = replay.Transition(
            obs={"x": np.asarray(code[..., None], np.float32)},
            action=iteration % 4 + np.zeros_like(code, np.uint8),
            reward=np.asarray(code, np.float32),
            next_obs={"x": np.asarray(code[..., None] + 1, np.float32)},
            terminated=done & (iteration % 2 == 0),
            done=done,
        )
        returns = (rng.random((SOURCES, ENVS)) - 0.5).astype(np.float32)
        episode = replay.Episode(
            w={"p": np.stack([code, code + 0.5], -1).astype(np.float32)},
            env=env.astype(np.int32),
            end=np.full((SOURCES, ENVS), iteration, np.int32),
            length=length.copy(),
            episode_return=returns,
            success=returns > 0,
        )
        rings = write(rings, np.int32(iteration), transition, episode, done)
        for s, e in zip(*np.nonzero(done), strict=True):
            finished[s].append((e, iteration, length[s, e], returns[s, e]))
        length[done] = 0
    return rings, finished


@pytest.mark.parametrize("iterations", [5, 16, 41])
def test_transitions_lie_at_their_iteration_modulo_the_capacity(iterations):
    rings, _ = _written(iterations)
    stored = np.asarray(rings.transitions.obs["x"])[..., 0]
    for iteration in range(max(0, iterations - COLUMNS), iterations):
        expected = [[_code(s, e, iteration) for e in range(ENVS)] for s in range(SOURCES)]
        np.testing.assert_array_equal(stored[:, :, iteration % COLUMNS], expected)


@pytest.mark.parametrize("iterations", [5, 41])
def test_finished_episodes_are_kept_in_order_and_counted(iterations):
    rings, finished = _written(iterations)
    for source in range(SOURCES):
        count = len(finished[source])
        assert rings.finished[source] == count
        for i in range(max(0, count - SLOTS), count):
            env, end, length, episode_return = finished[source][i]
            slot = jax.tree.map(lambda ring, i=i, source=source: np.asarray(ring[source, i % SLOTS]), rings.episodes)
            assert (slot.env, slot.end, slot.length) == (env, end, length)
            assert slot.episode_return == episode_return
            assert slot.w["p"][0] == _code(source, env, end)


def test_return_range_covers_finished_episodes_of_all_sources_and_is_unbounded_before():
    rings, finished = _written(30)
    returns = [episode[3] for source in finished for episode in source]
    np.testing.assert_allclose(rings.returns.bounds(), [min(returns), max(returns)])
    empty = replay.init(OBS, PARAM, sources=SOURCES, envs=ENVS, columns=COLUMNS, episodes=SLOTS)
    np.testing.assert_array_equal(empty.returns.bounds(), [-np.inf, np.inf])


@pytest.mark.parametrize("iterations", [3, 41])
def test_sampled_transitions_are_whole_recent_and_equally_shared(iterations):
    rings, _ = _written(iterations)
    batch = sample_transitions(
        rings,
        jax.random.key(1),
        jnp.int32(iterations - 1),
        batches=50,
        batch_size=64,
        n_step=1,
        gamma=0.5,
        success_share=0.0,
        horizon=1,
    )
    code = np.asarray(batch.reward)
    assert code.shape == (50, 64)
    np.testing.assert_array_equal(np.asarray(batch.obs["x"])[..., 0], code)
    np.testing.assert_array_equal(np.asarray(batch.next_obs["x"])[..., 0], code + 1)
    source, iteration = code // 10_000, code % 100
    assert (np.sum(source == 0, axis=1) == 32).all()
    assert iteration.min() >= max(0, iterations - COLUMNS)
    assert iteration.max() < iterations
    written = min(iterations, COLUMNS) * ENVS * SOURCES
    assert len(np.unique(code)) == written, "3,200 draws from at most 96 rows miss none"


def test_a_share_of_transitions_is_drawn_from_successful_episodes():
    """Every one that is still whole is as likely as any other, whatever its length, and every step of it."""
    rings, finished = _written(41, seed=3)
    longest = max(int(episode[2]) for source in finished for episode in source[-SLOTS:])
    batch = _sample_successes(rings, longest)
    for source in range(SOURCES):
        whole = [episode for episode in finished[source][-SLOTS:] if episode[1] > 40 - COLUMNS + longest]
        successes = [episode for episode in whole if episode[3] > 0]
        assert 1 < len(successes) < len(whole)
        drawn = batch[:, source, :24].ravel()
        for env, end, length, _ in successes:
            counts = [np.mean(drawn == _code(source, env, iteration)) for iteration in range(end - length + 1, end + 1)]
            np.testing.assert_allclose(counts, 1 / len(successes) / length, atol=0.02)
            np.testing.assert_allclose(np.sum(counts), 1 / len(successes), atol=0.02)


def test_a_source_without_success_is_drawn_uniformly():
    rings, finished = _written(41, seed=3)
    longest = max(int(episode[2]) for source in finished for episode in source[-SLOTS:])
    failed = rings.episodes.success.at[0].set(False)
    batch = _sample_successes(rings._replace(episodes=rings.episodes._replace(success=failed)), longest)
    assert len(np.unique(batch[:, 0, :24])) == COLUMNS * ENVS, "every step of the ring"
    assert len(np.unique(batch[:, 1, :24])) < COLUMNS * ENVS


def _sample_successes(rings, horizon):
    batch = sample_transitions(
        rings,
        jax.random.key(1),
        jnp.int32(40),
        batches=400,
        batch_size=64,
        n_step=1,
        gamma=0.5,
        success_share=0.75,
        horizon=horizon,
    )
    return np.asarray(batch.reward).reshape(400, SOURCES, 32).astype(int)


@pytest.mark.parametrize("n_step", [1, 2, 4])
def test_n_step_transitions_stop_at_the_end_of_the_episode_and_of_what_is_written(n_step):
    iterations, gamma = 41, 0.5
    rings, _ = _written(iterations)
    stored = jax.tree.map(np.asarray, rings.transitions)
    batch = sample_transitions(
        rings,
        jax.random.key(1),
        jnp.int32(iterations - 1),
        batches=20,
        batch_size=64,
        n_step=n_step,
        gamma=gamma,
        success_share=0.0,
        horizon=1,
    )
    batch = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), batch)
    spans = set()
    for first, reward, after, discount in zip(
        batch.obs["x"][:, 0], batch.reward, batch.next_obs["x"][:, 0], batch.discount, strict=True
    ):
        source, env, iteration = int(first // 10_000), int(first % 10_000 // 100), int(first % 100)
        expected, span = 0.0, 0
        while True:
            at = (source, env, (iteration + span) % COLUMNS)
            expected += gamma**span * stored.reward[at]
            span += 1
            if span == n_step or stored.done[at] or iteration + span == iterations:
                break
        spans.add(span)
        np.testing.assert_allclose(reward, expected, rtol=1e-6)
        assert after == first + span
        assert discount == (0.0 if stored.terminated[at] else gamma**span)
    assert spans == set(range(1, n_step + 1))


def test_sampled_rollouts_are_consistent_episodes_within_the_window():
    iterations, recent = 41, 8
    rings, finished = _written(iterations)
    for source in range(SOURCES):
        rollouts = sample_rollouts(
            rings,
            jax.random.key(2),
            jnp.int32(iterations - 1),
            source=source,
            batch_size=256,
            steps=5,
            recent=recent,
            recency=1.0,
        )
        eligible = {(e, end): (n, r) for e, end, n, r in finished[source][-SLOTS:] if end > iterations - 1 - recent}
        rollouts = jax.tree.map(np.asarray, rollouts)
        w = rollouts.w["p"][:, 0]
        seen = set()
        for b in range(256):
            env, end = int(w[b] % 10_000 // 100), int(w[b] % 100)
            length, episode_return = eligible[env, end]
            seen.add((env, end))
            assert rollouts.length[b] == length
            assert rollouts.episode_return[b] == episode_return
            first = _code(source, env, end - length + 1)
            assert rollouts.initial_obs["x"][b, 0] == first
            steps = rollouts.steps.reward[b]
            assert ((first <= steps) & (steps < first + length)).all()
        assert seen == set(eligible)


@pytest.mark.parametrize("recency", [1.0, 3.0])
def test_recent_episodes_are_drawn_as_often_as_is_asked(recency):
    """Of n episodes number k from the latest on is drawn if u^recency is in [k/n, (k+1)/n)."""
    rings, finished = _written(41)
    drawn = 20_000
    rollouts = sample_rollouts(
        rings, jax.random.key(3), jnp.int32(40), source=1, batch_size=drawn, steps=1, recent=30, recency=recency
    )
    latest = [(env, end) for env, end, *_ in finished[1][-SLOTS:] if end > 10][::-1]
    w = np.asarray(rollouts.w["p"][:, 0])
    counts = collections.Counter(zip((w % 10_000 // 100).astype(int).tolist(), (w % 100).astype(int).tolist(), strict=True))
    edges = (np.arange(len(latest) + 1) / len(latest)) ** (1 / recency)
    assert len(latest) > 4
    np.testing.assert_allclose([counts[episode] / drawn for episode in latest], np.diff(edges), atol=0.02)


def test_recent_outcome_is_the_mean_of_the_last_episodes_only():
    rings, finished = _written(41)
    outcome = recent_outcome(rings, source=1, window=4)
    last = [episode[3] for episode in finished[1][-4:]]
    np.testing.assert_allclose(outcome["episode_return"], np.mean(last), rtol=1e-6)
    np.testing.assert_allclose(outcome["success"], np.mean(np.array(last) > 0))
    empty = replay.init(OBS, PARAM, sources=SOURCES, envs=ENVS, columns=COLUMNS, episodes=SLOTS)
    assert np.isnan(recent_outcome(empty, source=0, window=4)["episode_return"])


def test_recent_outcome_leaves_out_what_began_too_early():
    rings, finished = _written(41)
    since = finished[1][-3][1]
    recent = [episode_return for _, end, length, episode_return in finished[1] if end - length + 1 >= since]
    outcome = recent_outcome(rings, source=1, window=SLOTS, since=since)
    assert 0 < len(recent) < sum(end >= since for _, end, _, _ in finished[1]) < SLOTS
    np.testing.assert_allclose(outcome["episode_return"], np.mean(recent), rtol=1e-6)
    assert np.isnan(recent_outcome(rings, source=1, window=SLOTS, since=41)["episode_return"])
