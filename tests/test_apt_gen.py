"""The generator follows V1 + beta V2, and each model learns from its own loss alone."""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tests.corridor import Corridor
from tests.test_trainer import CONFIG, run

from apt_jax.config import HParams
from apt_jax.curricula import apt_gen as module
from apt_jax.specs import Grid

SPACE = Corridor()
CONFIG = dataclasses.replace(CONFIG, model_batch_size=64)


class Bowl(nn.Module):
    """A value network with a known optimum: highest where the goal is `centre`."""

    param_spec: object

    @nn.compact
    def __call__(self, w):
        centre = self.param("centre", nn.initializers.zeros, ())
        return -((w["goal"][..., 0] - centre) ** 2) / 10.0


@pytest.fixture
def experience():
    """A replay with finished episodes of both sources."""
    states, clock, _ = run(dataclasses.replace(CONFIG, method="random"), [0])
    return jax.tree.map(lambda x: x[0], states.replay), clock.iteration


@pytest.mark.parametrize(("beta", "optimum"), [(0.125, 2.667), (3.0, 6.5), (8.0, 7.333)])
def test_generator_reaches_the_optimum_of_v1_plus_beta_v2(monkeypatch, experience, beta, optimum):
    """V1 peaks at 2 and V2 at 8, so the sum peaks at (2 + 8 beta) / (1 + beta)."""
    monkeypatch.setattr(module, "ValueNetwork", Bowl)
    replay, iteration = experience
    hparams = HParams(value_learning_rate=0.0, generator_learning_rate=1e-2)
    curriculum = module.apt_gen(SPACE, CONFIG)
    state = curriculum.init(jax.random.key(0), hparams)
    v1, v2 = ({"params": {"centre": jnp.float32(c)}} for c in (2.0, 8.0))
    state = state._replace(models=state.models._replace(progress_value=v1, return_value=v2), beta=jnp.float32(beta))

    @jax.jit
    def train(state):
        def update(state, key):
            return curriculum.update(state, key, replay, iteration, hparams)[0], None

        return jax.lax.scan(update, state, jax.random.split(jax.random.key(1), 400))[0]

    goal = curriculum.propose(train(state), jax.random.key(2), 256)["goal"]
    np.testing.assert_allclose(jnp.mean(goal), optimum, atol=0.3)


def test_discriminator_and_values_learn_from_the_same_experience(experience):
    replay, iteration = experience
    hparams = HParams(discriminator_learning_rate=3e-3, value_learning_rate=3e-3, generator_learning_rate=0.0)
    curriculum = module.apt_gen(SPACE, CONFIG)
    state = curriculum.init(jax.random.key(0), hparams)

    @jax.jit
    def train(state):
        def update(state, key):
            return curriculum.update(state, key, replay, iteration, hparams)

        return jax.lax.scan(update, state, jax.random.split(jax.random.key(1), 400))

    trained, metrics = train(state)
    late = jax.tree.map(lambda x: np.mean(x[-50:]), metrics)
    assert late["discriminator_target_logit"] > 0.5 > -0.5 > late["discriminator_generated_logit"]
    assert late["v2_unexplained"] < 0.3
    for before, after in zip(jax.tree.leaves(state.models.generator), jax.tree.leaves(trained.models.generator), strict=True):
        np.testing.assert_array_equal(before, after, err_msg="a rate of zero must leave the generator alone")


def test_values_see_the_task_that_is_played():
    spec = {"paint": Grid(1, 1, 3)}
    scores = jnp.array([[[0.2, 0.5, 0.3]]])
    seen = module.as_instantiated(spec, {"paint": scores})["paint"]
    np.testing.assert_allclose(seen, [[[0.0, 1.0, 0.0]]], atol=1e-6)
    weights = jnp.array([1.0, 2.0, 3.0])
    gradient = jax.grad(lambda s: jnp.sum(module.as_instantiated(spec, {"paint": s})["paint"] * weights[None, None]))(scores)
    np.testing.assert_allclose(gradient[0, 0], weights)


def test_probability_is_the_papers_form_of_progress():
    np.testing.assert_allclose(module.progress_score(jnp.array([0.0, 2.0]), "probability"), [0.5, 0.8808], rtol=1e-4)
    np.testing.assert_allclose(module.progress_score(jnp.array([0.0, 2.0]), "logit"), [0.0, 2.0])


def test_correlation():
    a = jnp.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(module.correlation(a, 3.0 * a - 1.0), 1.0, rtol=1e-4)
    np.testing.assert_allclose(module.correlation(a, -a), -1.0, rtol=1e-4)
    assert module.correlation(a, jnp.ones(3)) == 0.0


def test_proposals_do_not_depend_on_how_many_are_drawn_at_once():
    """Running statistics, not those of the batch: one task alone is as diverse as many."""
    curriculum = module.apt_gen(SPACE, CONFIG)
    state = curriculum.init(jax.random.key(0), HParams())
    singles = [curriculum.propose(state, key, 1)["goal"][0, 0] for key in jax.random.split(jax.random.key(3), 64)]
    assert np.std(singles) > 0.5
