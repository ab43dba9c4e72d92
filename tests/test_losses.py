"""Numeric oracles of the losses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax import losses


def _target(**changes):
    arguments = {
        "reward": jnp.ones(2),
        "discount": jnp.array([0.0, 1.0]),
        "next_q_selector": jnp.array([[0.0, 1.0, 0.0], [1.0, 2.0, 0.0]]),
        "next_q_value": jnp.array([[0.0, 1.0, 0.0], [1.0, 2.0, 0.0]]),
        "low": -jnp.inf,
        "high": jnp.inf,
    }
    return losses.td_target(**(arguments | changes))


def test_q_learning_oracle():
    q = jnp.array([[1.0, 1.0, 0.0], [1.0, 2.0, 0.0]])
    np.testing.assert_allclose(losses.td_errors(q, jnp.array([0, 1]), _target()), [0.0, 1.0])


def test_double_q_takes_the_selectors_action_and_the_other_networks_value():
    target = _target(
        next_q_selector=jnp.array([[2.0, 10.0, 1.0], [11.0, 20.0, 1.0]]),
        next_q_value=jnp.array([[99.0, 1.0, 98.0], [91.0, 2.0, 66.0]]),
    )
    q = jnp.array([[1.0, 1.0, 0.0], [1.0, 2.0, 0.0]])
    np.testing.assert_allclose(losses.td_errors(q, jnp.array([0, 1]), target), [0.0, 1.0])


def test_next_q_clip_bounds_the_bootstrap_not_the_target():
    next_q = jnp.array([[3.0, -9.0], [-0.7, -9.0], [0.4, -9.0]])
    target = losses.td_target(
        reward=jnp.array([-0.001, -0.001, 1.0]),
        discount=jnp.array([0.9, 0.9, 0.0]),
        next_q_selector=next_q,
        next_q_value=next_q,
        low=-0.5,
        high=1.0,
    )
    np.testing.assert_allclose(target, [0.899, -0.451, 1.0], rtol=1e-6)


def test_unbounded_clip_changes_nothing_and_makes_no_nan():
    np.testing.assert_allclose(_target(), [1.0, 3.0])


def test_discriminator_loss_pushes_where_it_is_wrong():
    gradient = jax.grad(lambda logit: losses.discriminator_loss(jnp.zeros(1), logit[None]))
    logits = [-8.0, -2.0, 0.0, 2.0, 8.0]
    np.testing.assert_allclose([gradient(x) for x in logits], [3.3535e-4, 0.119203, 0.5, 0.880797, 0.999665], rtol=1e-5)


def test_discriminator_gradient_raises_target_and_lowers_generated():
    raise_target, lower_generated = jax.grad(losses.discriminator_loss, argnums=(0, 1))(jnp.zeros(3), jnp.zeros(3))
    assert (raise_target < 0).all()
    assert (lower_generated > 0).all()


def test_generator_objective_is_equation_three():
    value = losses.generator_objective(jnp.array([1.0, 3.0]), jnp.array([0.5, 0.1]), beta=2.0, delta=0.5)
    np.testing.assert_allclose(value, 2.0 + 2.0 * (0.3 - 0.5), rtol=1e-6)


@pytest.mark.parametrize(
    ("beta", "episode_return", "expected"),
    [
        (1.0, 0.39, 2.0),
        (1.0, 0.41, 1.0),
        (1.0, 0.5, 1.0),
        (1.0, 0.59, 1.0),
        (1.0, 0.61, 0.5),
        (8.0, -1.0, 8.0),
        (6.0, -1.0, 8.0),
        (0.125, 1.0, 0.125),
        (0.2, 1.0, 0.125),
        (1.0, float("nan"), 1.0),
    ],
)
def test_beta_rule(beta, episode_return, expected):
    adapted = losses.adapt_beta(jnp.float32(beta), jnp.float32(episode_return), delta=0.5, tolerance=0.1, low=0.125, high=8.0)
    np.testing.assert_allclose(adapted, expected)


@pytest.mark.parametrize(
    ("episode_return", "expected"),
    [(0.5, 1.5), (0.4, 3.0), (0.3, 6.0), (0.25, 8.0), (-1.0, 8.0), (0.6, 0.75), (0.9, 0.125), (float("nan"), 5.0)],
)
def test_proportional_beta(episode_return, expected):
    """Twice as much for each 0.1 below delta, whatever beta was."""
    adapted = losses.proportional_beta(
        jnp.float32(5.0), jnp.float32(episode_return), neutral=1.5, delta=0.5, tolerance=0.1, low=0.125, high=8.0
    )
    np.testing.assert_allclose(adapted, expected, rtol=1e-5)
