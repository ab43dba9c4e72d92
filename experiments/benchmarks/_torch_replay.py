"""The replay of the PyTorch fixture: rings of numpy arrays, sampled by the rules of `apt_jax.replay`.

Axes: S sources, E environments per source, T columns, N episode slots.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from apt_jax.config import Config
from apt_jax.specs import obs_struct, param_struct
from envs.grid_world.dynamics import HORIZON
from envs.grid_world.observation import OBS_SPEC
from envs.grid_world.placement import PARAM_SPEC
from experiments.benchmarks._torch_networks import Tensors

SOURCES = 2
LONG_AGO = np.iinfo(np.int32).min


class Batch(NamedTuple):
    """Transitions to learn from, leaves [B, ...]; `discount` is 0 after a termination, otherwise gamma."""

    obs: Tensors
    action: Int[Tensor, "B"]
    reward: Float[Tensor, "B"]
    next_obs: Tensors
    discount: Float[Tensor, "B"]


class Rollouts(NamedTuple):
    """Finished episodes with K of the steps of each, leaves [B, ...] and [B, K, ...]."""

    w: Tensors
    initial_obs: Tensors
    obs: Tensors
    action: Int[Tensor, "B K"]
    reward: Float[Tensor, "B K"]
    next_obs: Tensors
    length: Int[Tensor, "B"]
    episode_return: Float[Tensor, "B"]


class Replay:
    """A ring of transitions for each environment and a ring of finished episodes for each source.

    Column `i % T` holds iteration i, slot `i % N` a source's i-th finished episode; `low` and `high` are the smallest and
    the largest return of any episode so far.
    """

    def __init__(self, config: Config, rng: np.random.Generator) -> None:
        self.rng = rng
        self.envs, self.columns = config.envs_per_source, config.replay_steps // config.envs_per_source
        step, slot = (SOURCES, self.envs, self.columns), (SOURCES, config.replay_episodes)
        self.obs, self.next_obs = _rings(obs_struct(OBS_SPEC), step), _rings(obs_struct(OBS_SPEC), step)
        self.action = np.zeros(step, np.int64)
        self.reward = np.zeros(step, np.float32)
        self.terminated = np.zeros(step, bool)
        self.w = _rings(param_struct(PARAM_SPEC), slot)
        self.env = np.zeros(slot, np.int64)
        self.end = np.full(slot, LONG_AGO)
        self.length = np.ones(slot, np.int64)
        self.episode_return = np.zeros(slot, np.float32)
        self.success = np.zeros(slot, bool)
        self.finished = [0] * SOURCES
        self.low, self.high = np.inf, -np.inf

    def write_step(
        self,
        source: int,
        env: int,
        iteration: int,
        *,
        obs: Mapping[str, Any],
        action: int,
        reward: float,
        next_obs: Mapping[str, Any],
        terminated: bool,
    ) -> None:
        """Stores a transition."""
        at = source, env, iteration % self.columns
        for name in self.obs:
            self.obs[name][at] = obs[name]
            self.next_obs[name][at] = next_obs[name]
        self.action[at], self.reward[at], self.terminated[at] = action, reward, terminated

    def write_episode(
        self,
        source: int,
        env: int,
        iteration: int,
        *,
        w: Mapping[str, np.ndarray],
        length: int,
        episode_return: float,
        success: bool,
    ) -> None:
        """Stores an episode that ended with `iteration`."""
        at = source, self.finished[source] % self.env.shape[1]
        for name, ring in self.w.items():
            ring[at] = w[name]
        self.env[at], self.end[at], self.length[at] = env, iteration, length
        self.episode_return[at], self.success[at] = episode_return, success
        self.finished[source] += 1
        self.low, self.high = min(self.low, episode_return), max(self.high, episode_return)

    def sample_transitions(self, iteration: int, *, batch_size: int, success_share: float, gamma: float) -> Batch:
        """Transitions in equal shares from the sources, `success_share` of them from successful episodes if any."""
        share = batch_size // SOURCES
        drawn = [self._draw_steps(source, iteration, share, round(success_share * share)) for source in range(SOURCES)]
        source = np.repeat(np.arange(SOURCES), share)
        env, step = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
        at = source, env, step % self.columns
        return Batch(
            obs=_pick(self.obs, at),
            action=torch.from_numpy(self.action[at]),
            reward=torch.from_numpy(self.reward[at]),
            next_obs=_pick(self.next_obs, at),
            discount=torch.from_numpy(np.where(self.terminated[at], 0.0, gamma).astype(np.float32)),
        )

    def _draw_steps(self, source: int, iteration: int, n: int, of_successes: int) -> tuple[np.ndarray, np.ndarray]:
        """Environments and iterations of `n` steps, the first `of_successes` of them from successful episodes."""
        env = self.rng.integers(self.envs, size=n)
        step = iteration - self.rng.integers(min(iteration + 1, self.columns), size=n)
        # The first steps of an episode that ended longer ago may be overwritten.
        whole = self.end[source] > iteration - self.columns + HORIZON
        successes = np.flatnonzero(whole & self.success[source])
        if of_successes and len(successes):
            slot = self.rng.choice(successes, size=of_successes)
            env[:of_successes] = self.env[source, slot]
            step[:of_successes] = self.end[source, slot] - self.rng.integers(self.length[source, slot])
        return env, step

    def sample_rollouts(
        self, iteration: int, *, source: int, batch_size: int, steps: int, recent: int, recency: float
    ) -> Rollouts:
        """Episodes of a source that ended within the last `recent` iterations, and `steps` of the steps of each."""
        count = int(np.sum(self.end[source] > iteration - recent))
        back = (self.rng.random(batch_size) ** recency * count).astype(int)
        slot = (self.finished[source] - 1 - back) % self.env.shape[1]
        length = self.length[source, slot]
        start = self.end[source, slot] - length + 1
        env = self.env[source, slot]
        offset = self.rng.integers(length[:, None], size=(batch_size, steps))
        first, at = (source, env, start % self.columns), (source, env[:, None], (start[:, None] + offset) % self.columns)
        return Rollouts(
            w=_pick(self.w, (source, slot)),
            initial_obs=_pick(self.obs, first),
            obs=_pick(self.obs, at),
            action=torch.from_numpy(self.action[at]),
            reward=torch.from_numpy(self.reward[at]),
            next_obs=_pick(self.next_obs, at),
            length=torch.from_numpy(length),
            episode_return=torch.from_numpy(self.episode_return[source, slot]),
        )

    def recent_return(self, *, source: int, window: int, since: int) -> float:
        """Mean return of those of a source's last `window` episodes that began at `since` or later, NaN if none did."""
        slot = (self.finished[source] - 1 - np.arange(min(self.finished[source], window))) % self.env.shape[1]
        began = self.end[source, slot] - self.length[source, slot] + 1
        counted = self.episode_return[source, slot][began >= since]
        return float(counted.mean()) if len(counted) else float("nan")


def _rings(struct: Mapping[str, jax.ShapeDtypeStruct], leading: tuple[int, ...]) -> dict[str, np.ndarray]:
    return {name: np.zeros(leading + block.shape, block.dtype) for name, block in struct.items()}


def _pick(rings: Mapping[str, np.ndarray], at: tuple[Any, ...]) -> Tensors:
    return {name: torch.from_numpy(ring[at]) for name, ring in rings.items()}
