"""Random numbers drawn in a row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax import draws


def key():
    """The same each time."""
    return jax.random.key(3)


@pytest.mark.parametrize("shape", [(), (7,), (2, 5, 3)])
def test_uniform_draws_the_numbers_of_jax(shape):
    np.testing.assert_array_equal(draws.uniform(key(), shape), jax.random.uniform(key(), shape))


def test_integers_are_even_below_their_bounds():
    bounds = np.array([1, 3, 10])
    drawn = np.asarray(draws.integers(key(), (20_000, 3), jnp.array(bounds)))
    assert drawn.dtype == np.int32
    for numbers, bound in zip(drawn.T, bounds, strict=True):
        share = np.bincount(numbers, minlength=bound) / len(numbers)
        np.testing.assert_allclose(share, 1 / bound, atol=4 * np.sqrt(1 / bound / len(numbers)))


def test_columns_of_one_draw_are_independent():
    drawn = np.asarray(draws.integers(key(), (20_000, 2), 10))
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.03


def test_the_largest_bound_is_kept():
    bound = jnp.int32(2**31 - 1)
    drawn = draws.integers(key(), (1000,), bound)
    assert drawn.min() >= 0
    assert 2**30 < drawn.max() < bound
