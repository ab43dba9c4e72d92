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


class _Playing(NamedTuple):
    """Episodes under way; those that are over are stepped on but count no more."""

    key: Key[Array, ""]
    state: Any
    obs: Obs
    over: Bool[Array, "n"]
    outcome: Outcome


def play(space: TaskSpace, tasks: Any, policy: Policy, key: Key[Array, ""]) -> Outcome:
    """One episode on each task (leaves [n, ...]), all side by side for `space.horizon` steps; consumes `key`."""
    n = jax.tree.leaves(tasks)[0].shape[0]
    key_reset, key_policy = jax.random.split(key)
    state, obs = jax.vmap(space.reset)(jax.random.split(key_reset, n), tasks)

    def step(carry: _Playing, _: None) -> tuple[_Playing, None]:
        key, key_action = jax.random.split(carry.key)
        out = jax.vmap(space.step)(carry.state, policy(carry.obs, key_action), tasks)
        outcome = Outcome(
            episode_return=carry.outcome.episode_return + jnp.where(carry.over, 0.0, out.reward),
            success=carry.outcome.success | (out.success & ~carry.over),
            length=carry.outcome.length + jnp.where(carry.over, 0, 1),
        )
        return _Playing(key, out.state, out.obs, carry.over | out.terminated | out.truncated, outcome), None

    start = Outcome(jnp.zeros(n), jnp.zeros(n, bool), jnp.zeros(n, jnp.int32))
    playing = _Playing(key_policy, state, obs, jnp.zeros(n, bool), start)
    return jax.lax.scan(step, playing, length=space.horizon)[0].outcome
