"""The generator follows V1 + beta V2, and each model learns from its own loss alone."""

from __future__ import annotations

import dataclasses
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax import evaluation
from apt_jax import replay as rp
from apt_jax.config import HParams
from apt_jax.curricula import apt_gen
from apt_jax.curricula import apt_gen_objectives as objectives
from apt_jax.descent import ADAM
from apt_jax.networks.generator import OUTPUT_NORM
from apt_jax.specs import Grid, Table
from experiments.examples.corridor import Corridor
from tests.test_trainer import CONFIG, run

SPACE = Corridor()
CONFIG = dataclasses.replace(CONFIG, model_batch_size=32)


class Bowl(nn.Module):
    """A value network with a known optimum: highest where the goal is `centre`."""

    param_spec: object

    @nn.compact
    def __call__(self, w):
        centre = self.param("centre", nn.initializers.zeros, ())
        return -((w["goal"][..., 0] - centre) ** 2) / 10.0


@pytest.fixture(scope="module")
def experience():
    """A replay with finished episodes of both sources."""
    states, clock, _ = run(dataclasses.replace(CONFIG, method="random"), [0])
    return jax.tree.map(lambda x: x[0], states.replay), clock.iteration - 1


@pytest.fixture(scope="module")
def fresh():
    """The state that training starts with."""
    return jax.jit(apt_gen.make(SPACE, CONFIG).init)(jax.random.key(0), HParams())


def with_values(state, **parameters):
    """The state of value networks, in ensembles of one, whose one parameter is V1's and V2's of what is given."""
    ((name, (v1, v2)),) = parameters.items()
    progress_value, return_value = ({"params": {name: jnp.full(1, value)}} for value in (v1, v2))
    models = state.models._replace(progress_value=progress_value, return_value=return_value)
    return state._replace(models=models, opt_state=ADAM.init(models))


def proposer(curriculum, number):
    """`propose(state, hparams)`: goals of some tasks."""
    return jax.jit(lambda state, hparams: curriculum.propose(state, jax.random.key(2), number, hparams)["goal"])


def trainer(curriculum, experience, rounds):
    """`train(state, hparams)`: the state after some updates on the same experience, and the metrics of each."""
    replay, iteration = experience

    @jax.jit
    def train(state, hparams):
        return jax.lax.scan(
            lambda state, key: curriculum.update(state, key, replay, iteration, hparams),
            state,
            jax.random.split(jax.random.key(1), rounds),
        )

    return train


@pytest.mark.parametrize(
    ("weights", "optima"),
    [
        ({}, {0.125: 2.667, 3.0: 6.5, 8.0: 7.333}),
        ({"progress_weight": 0.0}, {1.0: 8.0}),
        ({"return_weight": 0.0}, {1.0: 2.0}),
    ],
)
def test_generator_reaches_the_optimum_of_v1_plus_beta_v2(monkeypatch, fresh, experience, weights, optima):
    """V1 peaks at 2 and V2 at 8, so the sum peaks at (2 + 8 beta) / (1 + beta); an ablation leaves one of them."""
    monkeypatch.setattr(objectives, "ValueNetwork", Bowl)
    hparams = HParams(value_learning_rate=0.0, generator_learning_rate=2e-2, vector_noise=0.0)
    curriculum = apt_gen.make(SPACE, CONFIG, **weights)
    state = with_values(fresh, centre=(2.0, 8.0))

    train, propose = trainer(curriculum, experience, rounds=200), proposer(curriculum, 256)
    for beta, optimum in optima.items():
        trained, _ = train(state._replace(beta=jnp.float32(beta)), hparams)
        np.testing.assert_allclose(np.mean(propose(trained, hparams)), optimum, atol=0.3)


class Indifferent(nn.Module):
    """A value network to which all tasks are equal."""

    param_spec: object

    @nn.compact
    def __call__(self, w):
        return 0.0 * w["goal"][..., 0] + self.param("value", nn.initializers.zeros, ())


def test_prior_brings_a_number_back_from_the_end_of_its_range(monkeypatch, fresh, experience):
    monkeypatch.setattr(objectives, "ValueNetwork", Indifferent)
    hparams = HParams(value_learning_rate=0.0, generator_learning_rate=5e-2)
    curriculum = apt_gen.make(SPACE, CONFIG)
    state = with_values(fresh, value=(0.0, 0.0))
    goal = state.models.generator["goal"]
    norm = goal[OUTPUT_NORM] | {"bias": jnp.full(1, 6.0), "scale": jnp.full(1, 0.05)}
    generator = state.models.generator | {"goal": goal | {OUTPUT_NORM: norm}}
    state = state._replace(models=state.models._replace(generator=generator))

    train, propose = trainer(curriculum, experience, rounds=400), proposer(curriculum, 512)
    for prior, mean, deviation in ((0.0, 8.98, 0.0), (0.03, 4.5, 1.9)):
        trained, _ = train(state, hparams.replace(vector_prior=prior))
        goals = np.asarray(propose(trained, hparams))
        np.testing.assert_allclose((goals.mean(), goals.std()), (mean, deviation), atol=0.2)


@pytest.mark.parametrize("judge_parts", [False, True])
def test_discriminator_and_values_learn_from_the_same_experience(fresh, experience, judge_parts):
    hparams = HParams(discriminator_learning_rate=3e-3, value_learning_rate=3e-3, generator_learning_rate=0.0)
    curriculum = apt_gen.make(SPACE, dataclasses.replace(CONFIG, judge_parts=judge_parts))
    trained, metrics = trainer(curriculum, experience, rounds=400)(fresh, hparams)
    late = jax.tree.map(lambda x: np.mean(x[-50:]), metrics)
    assert late["discriminator_target_logit"] > 0.5 > -0.5 > late["discriminator_generated_logit"]
    assert late["v2_unexplained"] < 0.3
    for before, after in zip(jax.tree.leaves(fresh.models.generator), jax.tree.leaves(trained.models.generator), strict=True):
        np.testing.assert_array_equal(before, after, err_msg="a rate of zero must leave the generator alone")


def test_values_see_the_task_that_is_played():
    spec = {"paint": Grid(1, 1, 3)}
    scores = jnp.array([[[0.2, 0.5, 0.3]]])
    seen = objectives.as_instantiated(spec, {"paint": scores})["paint"]
    np.testing.assert_allclose(seen, [[[0.0, 1.0, 0.0]]], atol=1e-6)
    weights = jnp.array([1.0, 2.0, 3.0])
    gradient = jax.grad(lambda s: jnp.sum(objectives.as_instantiated(spec, {"paint": s})["paint"] * weights[None, None]))(
        scores
    )
    np.testing.assert_allclose(gradient[0, 0], weights)


def test_pessimism_takes_deviations_off_the_mean_and_has_a_gradient_where_all_agree():
    np.testing.assert_allclose(objectives.pessimistic(jnp.array([[1.0], [3.0]]), 0.5), [1.5], rtol=1e-3)
    np.testing.assert_allclose(objectives.pessimistic(jnp.array([[2.0]]), 0.5), [2.0])
    gradient = jax.grad(lambda values: objectives.pessimistic(values, 1.0).sum())(jnp.ones((4, 3)))
    assert np.isfinite(gradient).all()


def test_progress_is_the_discriminators_probability():
    np.testing.assert_allclose(objectives.task_progress(jnp.array([0.0, 3.0]), relative=False), [0.5, 0.952574], rtol=1e-5)


def test_relative_progress_keeps_its_order_and_spread_whatever_the_logits():
    logit = jax.random.normal(jax.random.key(0), (500,))
    plain = objectives.task_progress(logit, relative=True)
    np.testing.assert_allclose(objectives.task_progress(30.0 * logit - 100.0, relative=True), plain, atol=1e-3)
    np.testing.assert_array_equal(jnp.argsort(plain), jnp.argsort(logit))
    np.testing.assert_allclose((jnp.mean(plain), jnp.std(plain)), (0.5, 0.21), atol=0.01)
    np.testing.assert_array_equal(objectives.task_progress(jnp.ones(3), relative=True), jnp.full(3, 0.5))


def test_correlation():
    a = jnp.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(apt_gen.correlation(a, 3.0 * a - 1.0), 1.0, rtol=1e-4)
    np.testing.assert_allclose(apt_gen.correlation(a, -a), -1.0, rtol=1e-4)
    np.testing.assert_allclose(apt_gen.correlation(1e-13 * a, 1e-25 * a), 1.0, rtol=1e-4)
    for constant in (jnp.ones(3), jnp.zeros(3), jnp.full(3, 0.1)):
        assert apt_gen.correlation(a, constant) == 0.0


def test_proposals_do_not_depend_on_how_many_are_drawn_at_once(fresh):
    """Running statistics, not those of the batch: one task alone is as diverse as many."""
    curriculum = apt_gen.make(SPACE, CONFIG)
    propose = jax.jit(lambda key: curriculum.propose(fresh, key, 1, HParams())["goal"][0, 0])
    singles = [propose(key) for key in jax.random.split(jax.random.key(3), 64)]
    assert np.std(singles) > 0.5


def test_exploration_replaces_a_share_of_cells_and_jitters_vectors_within_their_range():
    spec = SPACE.param_spec
    w = {"goal": jnp.full((4000, 1), 4.5), "paint": jnp.broadcast_to(jnp.array([0.0, 2.0]), (4000, 4, 4, 2))}
    hparams = HParams(cell_noise=0.2, vector_noise=0.1)
    explored = apt_gen.explore(spec, w, jax.random.key(0), hparams)
    flipped = jnp.argmax(explored["paint"], axis=-1) == 0
    np.testing.assert_allclose(jnp.mean(flipped), 0.1, atol=0.01, err_msg="half of the replaced cells change category")
    np.testing.assert_allclose(jnp.std(explored["goal"]), 0.9, rtol=0.05)
    assert explored["goal"].min() >= 0
    assert explored["goal"].max() <= 9
    still = apt_gen.explore(spec, w, jax.random.key(0), HParams(cell_noise=0.0, vector_noise=0.0))
    for name in w:
        np.testing.assert_array_equal(still[name], w[name])


def test_exploration_and_hardening_treat_a_table_like_a_grid():
    spec = {"places": Table(2, 4)}
    w = {"places": jnp.broadcast_to(jnp.array([0.0, 0.0, 2.0, 0.0]), (4000, 2, 4))}
    explored = apt_gen.explore(spec, w, jax.random.key(0), HParams(cell_noise=0.2))
    moved = jnp.argmax(explored["places"], axis=-1) != 2
    np.testing.assert_allclose(jnp.mean(moved), 0.15, atol=0.01, err_msg="three quarters of the replaced rows change")
    np.testing.assert_array_equal(objectives.as_instantiated(spec, w)["places"][0], [[0, 0, 1, 0]] * 2)


def generated_episodes(returns, ends):
    """A replay whose generated source finished these episodes."""
    empty = partial(rp.init, SPACE.obs_spec, SPACE.param_spec, sources=2, envs=CONFIG.envs_per_source, columns=100, episodes=64)
    rings = jax.tree.map(np.array, jax.jit(empty)())
    n = len(returns)
    rings.episodes.episode_return[1, :n], rings.episodes.end[1, :n] = returns, ends
    return rings._replace(finished=np.array([0, n], np.int32))


@pytest.mark.parametrize(
    ("rule", "returns", "ends", "beta"),
    [
        ("doubling", [-1.0, -1.0, 0.9], [3, 24, 25], 0.5),  # the warm-up lasts 25 iterations of 4 environments
        ("doubling", [0.9, 0.9, -1.0], [3, 24, 25], 2.0),
        ("doubling", [-1.0, -1.0], [3, 24], 1.0),
        ("proportional", [-1.0, -1.0, 0.75], [3, 24, 25], 2.0**-2.5),
        ("proportional", [-1.0, -1.0], [3, 24], 1.0),
    ],
)
def test_beta_follows_only_what_ended_after_the_warm_up(rule, returns, ends, beta):
    curriculum = apt_gen.make(SPACE, dataclasses.replace(CONFIG, beta_rule=rule))
    state = jax.eval_shape(curriculum.init, jax.random.key(0), HParams())._replace(beta=jnp.float32(1.0))

    @jax.jit
    def refreshed_beta(replay):
        return curriculum.refresh(state, jax.random.key(1), replay, jnp.int32(30), HParams()).beta

    np.testing.assert_allclose(refreshed_beta(generated_episodes(returns, ends)), beta, rtol=1e-6)


def test_an_unknown_rule_for_beta_is_refused():
    with pytest.raises(ValueError, match="beta_rule must be one of doubling, proportional, got 'halving'"):
        apt_gen.make(SPACE, dataclasses.replace(CONFIG, beta_rule="halving"))


def test_rollouts_hold_the_steps_of_their_episode_only():
    goals = jnp.arange(1, 9, dtype=jnp.int32)
    w = {"goal": goals[:, None].astype(jnp.float32) + 0.5, "paint": jnp.zeros((8, 4, 4, 2))}

    def right(obs, key):
        del key
        return jnp.ones(obs["position"].shape[0], jnp.int32)

    outcome, transitions = evaluation.play(SPACE, goals, right, jax.random.key(0))
    np.testing.assert_array_equal(outcome.length, goals)
    rollouts = evaluation.sample_rollouts(w, outcome, transitions, jax.random.key(1), steps=200)
    for task, goal in enumerate(goals):
        seen = rollouts.steps.obs["position"][task, :, 0]
        np.testing.assert_array_equal(np.unique(seen), np.arange(goal), err_msg="every step up to the goal, none after")
        np.testing.assert_array_equal(rollouts.steps.obs["offset"][task, :, 0], goal - seen.astype(jnp.int32))
    np.testing.assert_array_equal(rollouts.initial_obs["position"][:, 0], 0)
    np.testing.assert_allclose(rollouts.episode_return, outcome.episode_return)


def test_report_compares_each_value_network_with_its_own_truth(monkeypatch, fresh):
    """V2's ensemble knows the return but for a constant."""
    monkeypatch.setattr(objectives, "ValueNetwork", Bowl)
    curriculum = apt_gen.make(SPACE, CONFIG)
    state = with_values(fresh, centre=(8.0, 2.0))
    goals = jnp.arange(1, 9, dtype=jnp.int32)
    w = {"goal": goals[:, None].astype(jnp.float32), "paint": jnp.zeros((8, 4, 4, 2))}
    outcome, transitions = evaluation.play(SPACE, goals, lambda obs, _: jnp.ones(8, jnp.int32), jax.random.key(0))
    rollouts = evaluation.sample_rollouts(w, outcome, transitions, jax.random.key(1), steps=4)
    rollouts = rollouts._replace(episode_return=-((goals.astype(jnp.float32) - 2.0) ** 2) / 10.0 - 0.25)
    report = jax.jit(curriculum.report)(state, rollouts, HParams())
    np.testing.assert_allclose(report["v2_correlation"], 1.0, atol=1e-3)
    np.testing.assert_allclose(report["v2_bias"], 0.25, atol=1e-4)
    assert abs(report["v1_correlation"]) < 0.999
