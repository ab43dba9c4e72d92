"""Whole episodes of a fixed policy on given tasks, without learning and without auto-reset, and how much tasks differ."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from apt_jax import draws
from apt_jax.replay import Rollouts, Transition
from apt_jax.specs import Grid, Obs, Params, Spec, Table, Vector
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


def play(space: TaskSpace, tasks: Any, policy: Policy, key: Key[Array, ""]) -> tuple[Outcome, Transition]:
    """One episode on each task (leaves [n, ...]), all side by side for `space.horizon` steps; consumes `key`.

    Returns:
      The outcomes, and the transitions with leaves [n, horizon, ...], of which the first `length` belong to the episode.
    """
    n = jax.tree.leaves(tasks)[0].shape[0]
    key_reset, key_policy = jax.random.split(key)
    state, obs = jax.vmap(space.reset)(jax.random.split(key_reset, n), tasks)

    def step(carry: _Playing, _: None) -> tuple[_Playing, Transition]:
        key, key_action = jax.random.split(carry.key)
        action = policy(carry.obs, key_action)
        out = jax.vmap(space.step)(carry.state, action, tasks)
        done = out.terminated | out.truncated
        outcome = Outcome(
            episode_return=carry.outcome.episode_return + jnp.where(carry.over, 0.0, out.reward),
            success=carry.outcome.success | (out.success & ~carry.over),
            length=carry.outcome.length + jnp.where(carry.over, 0, 1),
        )
        transition = Transition(carry.obs, action, out.reward, out.obs, out.terminated, done)
        return _Playing(key, out.state, out.obs, carry.over | done, outcome), transition

    start = Outcome(jnp.zeros(n), jnp.zeros(n, bool), jnp.zeros(n, jnp.int32))
    playing = _Playing(key_policy, state, obs, jnp.zeros(n, bool), start)
    played, transitions = jax.lax.scan(step, playing, length=space.horizon)
    return played.outcome, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), transitions)


def sample_rollouts(w: Params, outcome: Outcome, transitions: Transition, key: Key[Array, ""], *, steps: int) -> Rollouts:
    """What `play` returned for tasks `w`, with `steps` transitions of each drawn with replacement; consumes `key`."""
    n = outcome.length.shape[0]
    at = draws.integers(key, (n, steps), outcome.length[:, None])
    return Rollouts(
        w=w,
        initial_obs=jax.tree.map(lambda x: x[:, 0], transitions.obs),
        steps=jax.tree.map(lambda x: x[jnp.arange(n, dtype=jnp.int32)[:, None], at], transitions),
        length=outcome.length,
        episode_return=outcome.episode_return,
    )


def diversity(spec: Spec, w: Params) -> dict[str, Float[Array, ""]]:
    """How much proposed tasks differ (leaves [n, ...]), per modality.

    `probe_entropy_*` of a grid or table: mean entropy of a category over tasks, as a share of the largest.
    `probe_spread_*` of a vector: mean standard deviation of a number over tasks, as a share of its range.
    """

    def entropy(scores: Array, categories: int) -> Array:
        share = jnp.mean(jax.nn.one_hot(jnp.argmax(scores, axis=-1), categories), axis=0)
        return jnp.mean(jnp.sum(jax.scipy.special.entr(share), axis=-1)) / math.log(categories)

    metrics = {}
    for name, modality in spec.items():
        match modality:
            case Grid() | Table():
                metrics[f"probe_entropy_{name}"] = entropy(w[name], modality.categories)
            case Vector():
                metrics[f"probe_spread_{name}"] = jnp.mean(jnp.std(w[name], axis=0)) / (modality.high - modality.low)
    return metrics
