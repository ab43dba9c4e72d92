"""Episodes of trained policies: scores and pictures."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, UInt8

import envs
from apt_jax import evaluation
from apt_jax.specs import Obs
from apt_jax.trainer import Trainer


def score(trainer: Trainer, policies: Any, task: Any, *, episodes: int, key: Key[Array, ""]) -> evaluation.Outcome:
    """Greedy episodes of every policy (leaves [L, ...]) on one task; leaves [L, episodes]; consumes `key`."""
    tasks = jax.tree.map(lambda x: jnp.broadcast_to(x, (episodes, *jnp.shape(x))), task)

    def play(params: Any) -> evaluation.Outcome:
        return evaluation.play(trainer.space, tasks, lambda obs, _: trainer.act(params, obs), key)[0]

    return jax.device_get(jax.jit(jax.vmap(play))(policies))


def film(
    space: envs.BenchmarkSpace, trainer: Trainer, policy: Any, task: Any, key: Key[Array, ""]
) -> list[UInt8[np.ndarray, "H W 3"]]:
    """Pictures of one greedy episode, from its first state to its last; consumes `key`."""

    def step(carry: tuple[Any, Obs], _: None) -> tuple[tuple[Any, Obs], tuple[Any, Array]]:
        state, obs = carry
        out = space.step(state, trainer.act(policy, obs), task)
        return (out.state, out.obs), (out.state, out.terminated | out.truncated)

    @jax.jit
    def rollout(key: Key[Array, ""]) -> tuple[Any, Any, Array]:
        state, obs = space.reset(key, task)
        _, (states, over) = jax.lax.scan(step, (state, obs), length=space.horizon)
        return state, states, over

    first, states, over = jax.device_get(rollout(key))
    steps = int(np.argmax(over)) + 1
    return [space.render(task, first)] + [
        space.render(task, jax.tree.map(lambda x: x[i], states))  # noqa: B023
        for i in range(steps)
    ]
