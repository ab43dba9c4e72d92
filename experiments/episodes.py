"""Episodes: scores and pictures of trained policies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

import envs
from apt_jax import evaluation
from apt_jax.specs import Obs
from apt_jax.trainer import Trainer


class Episode(NamedTuple):
    """One episode, fetched.

    Attributes:
      states: before the first step and after each.
      actions: one per step.
      success: whether it ended with success.
    """

    states: list[Any]
    actions: list[int]
    success: bool


def make_score(trainer: Trainer, episodes: int) -> Callable[[Any, Any, Key[Array, ""]], evaluation.Outcome]:
    """`score(policies, task, key)`: greedy episodes of every policy (leaves [L, ...]) on one task; consumes `key`.

    Returns:
      A function compiled once for all tasks, whose result has leaves [L, episodes].
    """

    def play(params: Any, task: Any, key: Key[Array, ""]) -> evaluation.Outcome:
        tasks = jax.tree.map(lambda x: jnp.broadcast_to(x, (episodes, *jnp.shape(x))), task)
        return evaluation.play(trainer.space, tasks, lambda obs, _: trainer.act(params, obs), key)[0]

    return jax.jit(jax.vmap(play, in_axes=(0, None, None)))


def play(
    space: envs.BenchmarkSpace, task: Any, act: Callable[[Obs, Int[Array, ""]], Int[Array, ""]], key: Key[Array, ""]
) -> Episode:
    """One episode of `act(obs, step)`, which says the action of each step, counted from 0; consumes `key`."""

    def advance(carry: tuple[Any, Obs], step: Int[Array, ""]) -> tuple[tuple[Any, Obs], tuple[Any, Array, Array, Array]]:
        state, obs = carry
        action = act(obs, step)
        out = space.step(state, action, task)
        return (out.state, out.obs), (out.state, action, out.terminated | out.truncated, out.success)

    @jax.jit
    def rollout(key: Key[Array, ""]) -> tuple[Any, tuple[Any, Array, Array, Array]]:
        state, obs = space.reset(key, task)
        return state, jax.lax.scan(advance, (state, obs), jnp.arange(space.horizon))[1]

    first, (states, actions, over, success) = jax.device_get(rollout(key))
    steps = int(np.argmax(over)) + 1 if over.any() else space.horizon
    after = [jax.tree.map(lambda x, i=i: x[i], states) for i in range(steps)]
    return Episode([first, *after], [int(action) for action in actions[:steps]], bool(success[steps - 1]))


def greedy(space: envs.BenchmarkSpace, trainer: Trainer, policy: Any, task: Any, key: Key[Array, ""]) -> Episode:
    """One episode of a trained policy; consumes `key`."""
    return play(space, task, lambda obs, _: trainer.act(policy, obs), key)
