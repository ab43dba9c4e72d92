"""Whole episodes of a fixed policy on given tasks, without learning and without auto-reset."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from apt_jax.specs import Obs
from apt_jax.task_space import TaskSpace

Policy = Callable[[Obs, Key[Array, ""]], Int[Array, "n"]]
"""`policy(obs, key) -> actions` for observations with leaves [n, ...]."""


class Outcome(NamedTuple):
    """Undiscounted return, success and number of steps of each episode."""

    episode_return: Float[Array, "n"]
    success: Bool[Array, "n"]
    length: Int[Array, "n"]


def play(space: TaskSpace, tasks: Any, policy: Policy, key: Key[Array, ""]) -> Outcome:
    """One episode on each task (leaves [n, ...]), all side by side for `space.horizon` steps; consumes `key`."""
    n = jax.tree.leaves(tasks)[0].shape[0]
    key_reset, key_policy = jax.random.split(key)
    state, obs = jax.vmap(space.reset)(jax.random.split(key_reset, n), tasks)

    def step(carry: tuple[Any, Obs, Bool[Array, "n"], Outcome], key: Key[Array, ""]) -> tuple[Any, None]:
        state, obs, over, outcome = carry
        out = jax.vmap(space.step)(state, policy(obs, key), tasks)
        outcome = Outcome(
            episode_return=outcome.episode_return + jnp.where(over, 0.0, out.reward),
            success=outcome.success | (out.success & ~over),
            length=outcome.length + jnp.where(over, 0, 1),
        )
        return (out.state, out.obs, over | out.terminated | out.truncated, outcome), None

    start = Outcome(jnp.zeros(n), jnp.zeros(n, bool), jnp.zeros(n, jnp.int32))
    carry = (state, obs, jnp.zeros(n, bool), start)
    (_, _, _, outcome), _ = jax.lax.scan(step, carry, jax.random.split(key_policy, space.horizon))
    return outcome
