"""The settings of conftest.py do what they say: each planted fault is an error."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxtyping
import optax
import pytest
from jax.errors import KeyReuseError

from apt_jax.losses import td_errors


def draw_twice(key):
    return jax.random.normal(key) + jax.random.uniform(key)


def scan_with_one_key(key):
    return jax.lax.scan(lambda carry, _: (carry, jax.random.normal(key)), 0, None, length=3)


def while_that_keeps_its_key(key):
    return jax.lax.while_loop(lambda c: c[1] < 3.0, lambda c: (c[0], c[1] + 1.0 + jax.random.uniform(c[0])), (key, 0.0))


def vmap_over_used_keys(key):
    return jax.vmap(draw_twice)(jax.random.split(key, 3))


def parent_after_split(key):
    return jax.random.split(key), jax.random.normal(key)


@pytest.mark.parametrize(
    "fault", [draw_twice, scan_with_one_key, while_that_keeps_its_key, vmap_over_used_keys, parent_after_split]
)
def test_reused_key_is_an_error(fault):
    with pytest.raises(KeyReuseError):
        jax.jit(fault).trace(jax.random.key(0))


def test_threaded_keys_pass():
    def body(key, _):
        key, draw_key = jax.random.split(key)
        return key, jax.random.normal(draw_key)

    keys = jax.random.split(jax.random.key(0), 3)
    _, draws = jax.jit(jax.vmap(lambda key: jax.lax.scan(body, key, None, length=4)))(keys)
    assert len(set(draws.ravel().tolist())) == 12


def test_mixed_dtypes_are_an_error():
    with pytest.raises(jax.dtypes.TypePromotionError, match="dtype_promotion=strict"):
        jnp.arange(3) * jnp.ones(3)


def test_mixed_ranks_are_an_error():
    with pytest.raises(ValueError, match="rank_promotion"):
        jnp.ones((2, 3)) * jnp.ones(3)


@pytest.mark.parametrize(
    ("q", "action"), [((3, 2), jnp.zeros(4, jnp.uint8)), ((2,), jnp.zeros(2, jnp.uint8)), ((3, 2), jnp.zeros(3))]
)
def test_what_an_annotation_excludes_is_an_error(q, action):
    with pytest.raises(jaxtyping.TypeCheckError, match="parameter 'action'" if len(q) == 2 else "parameter 'q'"):
        jax.eval_shape(td_errors, jnp.zeros(q), action, jnp.zeros(3))


@pytest.mark.relaxed("dtype", "rank", "keys", "types")
def test_relaxed_marker_allows_them():
    assert (jnp.arange(3) * jnp.ones((2, 3))).shape == (2, 3)
    draw_twice(jax.random.key(0))
    assert td_errors(jnp.ones((3, 2)), jnp.zeros(3), jnp.zeros(3)).shape == (3,)


def test_adam_runs_under_strict_promotion():
    optimizer = optax.adam(1e-3)
    params = {"w": jnp.ones(3)}
    updates, _ = jax.jit(optimizer.update)(params, optimizer.init(params))
    # The first step of Adam is the learning rate against the gradient's sign.
    assert jnp.allclose(updates["w"], -1e-3, rtol=1e-4)


def test_two_devices():
    assert jax.device_count() >= 2
