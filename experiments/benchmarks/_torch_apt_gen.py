"""APT-Gen on Grid-World the way such work is usually published: an eager PyTorch loop around an environment in Python.

What `apt_jax` is timed against, and checked by: the networks, losses and rules of its `apt_gen`, for any config with
`n_step` 1 and `beta_rule` "doubling".  Evaluation, and what goes by it (the restore rule, fresh Q-networks), are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import torch

from apt_jax.config import Config, HParams
from apt_jax.curricula.base import GENERATED, TARGET
from envs.grid_world.board import BOARD, CATEGORIES, Task
from envs.grid_world.placement import parameter
from experiments.benchmarks._python_grid_world import PythonGridWorld
from experiments.benchmarks._torch_models import Models
from experiments.benchmarks._torch_networks import ACTIONS
from experiments.benchmarks._torch_policy import Policy
from experiments.benchmarks._torch_replay import SOURCES, Replay


@dataclass
class Episode:
    """An environment in the middle of an episode of the task that `w` makes."""

    world: PythonGridWorld
    w: dict[str, np.ndarray]
    obs: dict[str, Any]
    length: int = 0
    episode_return: float = 0.0


class Training:
    """One seed.

    Args:
      target: the target task.
      compiled: use `torch.compile`.
    """

    def __init__(self, config: Config, hparams: HParams, target: Task, *, seed: int, compiled: bool = False) -> None:
        torch.manual_seed(seed)
        self.config, self.hparams = config, hparams
        self.rng = np.random.default_rng(seed)
        self.target: dict[str, np.ndarray] = jax.device_get(parameter(target))
        self.replay = Replay(config, self.rng)
        self.policy = Policy(hparams, compiled=compiled)
        self.models = Models(config, hparams, compiled=compiled)
        self.beta = hparams.beta_init
        self.iteration = 0
        self.episodes = [[self.begin(source) for _ in range(config.envs_per_source)] for source in (TARGET, GENERATED)]

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of all sources."""
        return SOURCES * self.config.envs_per_source

    def warm_up(self) -> None:
        """`Config.warmup_steps` of random actions, no updates."""
        for _ in range(self.config.warmup_steps // self.steps_per_iteration):
            self.collect(epsilon=1.0)
            self.iteration += 1

    def train(self, steps: int) -> None:
        """Goes on for `steps` environment steps of all sources."""
        config = self.config
        for _ in range(steps // self.steps_per_iteration):
            self.collect(self.epsilon())
            self.update_policy()
            self.update_models()
            self.iteration += 1
            if (self.iteration * self.steps_per_iteration - config.warmup_steps) % config.refresh_every == 0:
                self.refresh()

    def collect(self, epsilon: float) -> None:
        """One step of every environment, and a fresh episode where one ended."""
        episodes = [episode for of_source in self.episodes for episode in of_source]
        obs = {name: torch.from_numpy(np.array([episode.obs[name] for episode in episodes])) for name in episodes[0].obs}
        greedy = self.policy.act(obs).numpy()
        explore = self.rng.random(len(episodes)) < epsilon
        actions = iter(np.where(explore, self.rng.integers(ACTIONS, size=len(episodes)), greedy).tolist())
        for source in (TARGET, GENERATED):
            for env in range(self.config.envs_per_source):
                self.step(source, env, next(actions))

    def step(self, source: int, env: int, action: int) -> None:
        """One step of one environment."""
        episode = self.episodes[source][env]
        event, reward, terminated, truncated = episode.world.step(action)
        next_obs = episode.world.observation()
        self.replay.write_step(
            source,
            env,
            self.iteration,
            obs=episode.obs,
            action=action,
            reward=reward,
            next_obs=next_obs,
            terminated=terminated,
        )
        episode.obs = next_obs
        episode.length += 1
        episode.episode_return += reward
        if terminated or truncated:
            self.replay.write_episode(
                source,
                env,
                self.iteration,
                w=episode.w,
                length=episode.length,
                episode_return=episode.episode_return,
                success=event == "goal",
            )
            self.episodes[source][env] = self.begin(source)

    def begin(self, source: int) -> Episode:
        """The start of an episode of the target, or of a task made by the generator."""
        w = self.target if source == TARGET else self.propose()
        world = PythonGridWorld(w["tiles"].tolist(), w["xy"].tolist())
        return Episode(world, w, world.observation())

    def propose(self) -> dict[str, np.ndarray]:
        """A generated task with exploration noise."""
        w = {name: block[0].numpy() for name, block in self.models.propose().items()}
        noise = self.hparams.vector_noise * BOARD * self.rng.standard_normal(w["xy"].shape)
        w["xy"] = np.clip(w["xy"] + noise, 0, BOARD)
        replaced = self.rng.random(w["tiles"].shape[:2]) < self.hparams.cell_noise
        w["tiles"][replaced] = self.rng.random((replaced.sum(), CATEGORIES))
        return w

    def update_policy(self) -> None:
        """The policy updates of one iteration."""
        config = self.config
        for _ in range(config.updates_per_step * self.steps_per_iteration):
            batch = self.replay.sample_transitions(
                self.iteration,
                batch_size=config.batch_size,
                success_share=config.success_share,
                gamma=self.hparams.gamma,
            )
            self.policy.update(batch, self.replay.low, self.replay.high)

    def update_models(self) -> None:
        """The updates of discriminator, values and generator of one iteration."""
        config = self.config
        for _ in range(round(config.model_updates_per_step * self.steps_per_iteration)):
            target, generated = (
                self.replay.sample_rollouts(
                    self.iteration,
                    source=source,
                    batch_size=config.model_batch_size,
                    steps=config.rollout_steps,
                    recent=config.recent_steps // config.envs_per_source,
                    recency=recency,
                )
                for source, recency in ((TARGET, 1.0), (GENERATED, self.hparams.recency))
            )
            self.models.update(target, generated, beta=self.beta)

    def refresh(self) -> None:
        """Doubles or halves beta by the recent return of generated tasks; NaN leaves it."""
        config, hparams = self.config, self.hparams
        warm = config.warmup_steps // self.steps_per_iteration
        recent = self.replay.recent_return(source=GENERATED, window=config.return_window, since=warm)
        if recent < hparams.delta - hparams.tolerance:
            self.beta = min(2.0 * self.beta, hparams.beta_max)
        elif recent > hparams.delta + hparams.tolerance:
            self.beta = max(0.5 * self.beta, hparams.beta_min)

    def epsilon(self) -> float:
        """Exploration, falling linearly after the warm-up."""
        hparams = self.hparams
        steps = self.iteration * self.steps_per_iteration - self.config.warmup_steps
        fraction = min(steps / hparams.epsilon_steps, 1.0)
        return hparams.epsilon_start + fraction * (hparams.epsilon_end - hparams.epsilon_start)
