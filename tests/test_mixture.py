"""Mixtures against a worked case and against scikit-learn, from the same first labels."""

from __future__ import annotations

import warnings
from functools import partial

import jax
import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from apt_jax.curricula import mixture

fit = jax.jit(mixture.fit, static_argnames=("slots", "diagonal"))
k_means = jax.jit(mixture.k_means, static_argnames="slots")
draw = jax.jit(jax.vmap(mixture.draw, in_axes=(None, None, 0)))

ROWS = np.array(
    [
        [0, 0, 0],
        [1, 0, 0.1],
        [0, 1, 0],
        [1, 1, 0.1],
        [4, 4, 0.9],
        [5, 4, 1],
        [4, 5, 0.8],
        [5, 5, 0.7],
        [2, 2, 0.3],
        [3, 3, 0.5],
    ],
    np.float32,
)
LABELS = np.array([0, 0, 0, 0, 1, 1, 1, 1, 0, 1], np.int32)


class FromLabels(GaussianMixture):
    """scikit-learn's mixture, begun from given labels."""

    def __init__(self, labels, **kwargs):
        super().__init__(**kwargs)
        self.labels = labels

    def _initialize_parameters(self, X, random_state, **kwargs):
        self._initialize(X, np.eye(self.n_components)[self.labels])


def reference(rows, labels, k, regularisation):
    model = FromLabels(labels, n_components=k, reg_covar=regularisation)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return model.fit(rows.astype(np.float64))


def test_worked_case():
    result = fit(ROWS, np.ones(10, bool), LABELS, np.int32(2), slots=10, regularisation=1e-3)
    assert result.iterations == 3
    np.testing.assert_allclose(result.mixture.weights[:2], [0.505246, 0.494754], atol=1e-5)
    np.testing.assert_allclose(
        result.mixture.means[:2], [[0.823312, 0.823312, 0.104247], [4.212245, 4.212245, 0.782873]], atol=1e-4
    )
    np.testing.assert_allclose(result.aic, 62.913744, rtol=1e-5)


@pytest.mark.parametrize(("k", "parameters"), [(2, 19), (10, 99)])
def test_number_of_parameters(k, parameters):
    """Of one row that every component fits alike, the criterion is the parameters less twice the log-likelihood."""
    row = np.zeros((1, 3), np.float32)
    labels = np.zeros(1, np.int32)
    result = fit(row, np.ones(1, bool), labels, np.int32(k), slots=10, regularisation=1.0)
    likelihood = -1.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(result.aic, 2 * parameters - 2 * likelihood, rtol=1e-4)


def test_agrees_with_scikit_learn_for_every_number_of_components_at_once():
    """Means, weights, criterion and the number it chooses, with unused slots and rows that do not count."""
    rng = np.random.default_rng(0)
    rows = np.concatenate([rng.normal(centre, 0.15, (40, 3)) for centre in ([0, 0, 0], [1, 0, 1], [0, 2, 1])]).astype(
        np.float32
    )
    ks = np.arange(2, 11, dtype=np.int32)
    labels = np.stack([np.arange(len(rows), dtype=np.int32) * 7919 % k for k in ks])
    padding = 9
    padded = np.concatenate([rows, np.full((padding, 3), 50.0, np.float32)])
    valid = np.arange(len(padded)) < len(rows)

    def one(k, labels):
        return fit(padded, valid, labels, k, slots=10, regularisation=1e-3)

    results = jax.jit(jax.vmap(one))(ks, np.pad(labels, ((0, 0), (0, padding))))
    references = [reference(rows, labels[i], int(k), 1e-3) for i, k in enumerate(ks)]
    for i, (k, model) in enumerate(zip(ks, references, strict=True)):
        np.testing.assert_allclose(results.mixture.means[i, :k], model.means_, atol=5e-3)
        np.testing.assert_allclose(results.mixture.weights[i, :k], model.weights_, atol=5e-3)
        np.testing.assert_allclose(results.aic[i], model.aic(rows.astype(np.float64)), rtol=1e-3, atol=0.5)
        assert (np.asarray(results.mixture.weights[i, k:]) < 1e-5).all()
    assert np.argmin(results.aic) == np.argmin([model.aic(rows.astype(np.float64)) for model in references])


def test_a_diagonal_covariance_has_no_other_entries():
    result = fit(ROWS, np.ones(10, bool), LABELS, np.int32(2), slots=3, regularisation=1e-3, diagonal=True)
    factors = np.asarray(result.mixture.scale_tril)
    np.testing.assert_array_equal(factors, factors * np.eye(3))
    full = fit(ROWS, np.ones(10, bool), LABELS, np.int32(2), slots=3, regularisation=1e-3)
    assert np.any(np.asarray(full.mixture.scale_tril) * (1 - np.eye(3)) != 0)


def test_a_covariance_without_a_factor_gives_no_criterion():
    rows = np.zeros((4, 2), np.float32)
    result = fit(rows, np.ones(4, bool), np.zeros(4, np.int32), np.int32(2), slots=3, regularisation=-1.0)
    assert np.isnan(result.aic)
    assert result.iterations < 3, "and ends at once"


@pytest.mark.parametrize("size", [1, 2, 7, 16, 33])
def test_inverse_of_a_triangle(size):
    lower = np.tril(np.random.default_rng(size).normal(size=(size, size))).astype(np.float32)
    lower[np.diag_indices(size)] = 2.0 + np.abs(lower[np.diag_indices(size)])
    np.testing.assert_allclose(jax.jit(mixture.invert_lower)(lower) @ lower, np.eye(size), atol=1e-3)


def test_draws_have_the_components_mean_and_covariance():
    fitted = fit(ROWS, np.ones(10, bool), LABELS, np.int32(2), slots=4, regularisation=1e-3).mixture
    logits = np.array([-np.inf, 0.0, -np.inf, -np.inf], np.float32)
    rows = np.asarray(draw(fitted, logits, jax.random.split(jax.random.key(0), 20_000)))
    factor = np.asarray(fitted.scale_tril[1])
    np.testing.assert_allclose(rows.mean(0), fitted.means[1], atol=0.03)
    np.testing.assert_allclose(np.cov(rows.T), factor @ factor.T, atol=0.03)


def test_k_means_tells_separate_clusters_apart():
    rng = np.random.default_rng(1)
    centres = np.array([[0, 0], [5, 0], [0, 5]])
    rows = (np.repeat(centres, 20, axis=0) + rng.normal(0, 0.2, (60, 2))).astype(np.float32)
    labels = np.asarray(k_means(rows, np.ones(60, bool), np.int32(3), jax.random.key(2), slots=6)).reshape(3, 20)
    assert (labels == labels[:, :1]).all()
    assert sorted(labels[:, 0]) == [0, 1, 2]


def test_k_means_begins_far_apart():
    """Rows far from a crowd and from each other become centres, however many the crowd is."""
    rows = np.random.default_rng(2).normal(0, 0.5, (400, 2)).astype(np.float32)
    rows[7], rows[8] = (40.0, 40.0), (40.0, -40.0)
    keys = jax.random.split(jax.random.key(0), 20)
    each = jax.vmap(partial(k_means, slots=4), in_axes=(None, None, None, 0))
    labels = np.asarray(each(rows, np.ones(400, bool), np.int32(3), keys))
    for far in (7, 8):
        assert ((labels == labels[:, far, None]).sum(axis=1) == 1).all()
