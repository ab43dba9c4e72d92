"""What a run is made of: static `Config` (sizes, names) and traced `HParams` (numbers)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import flax.struct


@flax.struct.dataclass
class HParams:
    """Numbers that may differ from lane to lane of one compiled program; every field is a float32 scalar once traced.

    Attributes:
      learning_rate: Adam step size of the policy, >= 0 (paper: 3e-4).
      discriminator_learning_rate: Adam step size of the discriminator, >= 0 (paper: 3e-4).
      value_learning_rate: Adam step size of both value networks, >= 0 (paper: 3e-4).
      generator_learning_rate: Adam step size of the generator, >= 0 (paper: 3e-4).
      gamma: discount of the Q-learning target, in [0, 1].
      target_rate: Polyak rate of the target network per policy update, in [0, 1].
      epsilon_start: exploration right after warm-up, in [0, 1].
      epsilon_end: exploration in the long run, in [0, 1].
      epsilon_steps: environment steps over which epsilon falls linearly, > 0.
      delta: wanted return of generated tasks (paper: 0.5).
      tolerance: band around `delta` in which beta stays (paper: 0.1).
      beta_init: beta at the start.
      beta_min: lower bound of beta (paper: 1/8).
      beta_max: upper bound of beta (paper: 8).
      pessimism: standard deviations of the value ensemble taken off its mean, >= 0; nothing for an ensemble of one.
      value_weight_decay: decoupled weight decay of the value networks, per unit of their learning rate, >= 0.
      cell_noise: probability that a cell of a generated grid is played with a uniformly drawn category, in [0, 1] (paper: 0).
      vector_noise: standard deviation of the noise on generated vectors, as a share of their range, >= 0 (paper: 0).
      spectral_bound: upper bound of the spectral norm of every layer of the discriminator, > 0 (paper: none).
    """

    learning_rate: float = 3e-4
    discriminator_learning_rate: float = 3e-4
    value_learning_rate: float = 3e-4
    generator_learning_rate: float = 3e-4
    gamma: float = 0.99
    target_rate: float = 0.005
    epsilon_start: float = 1.0
    epsilon_end: float = 0.1
    epsilon_steps: float = 1_000.0
    delta: float = 0.5
    tolerance: float = 0.1
    beta_init: float = 1.0
    beta_min: float = 0.125
    beta_max: float = 8.0
    pessimism: float = 1.0
    value_weight_decay: float = 0.0
    cell_noise: float = 0.0
    vector_noise: float = 0.0
    spectral_bound: float = math.inf


def check_hparams(hparams: HParams) -> None:
    """Check the ranges that the fields' descriptions give; for plain numbers, before they are traced.

    Raises:
      ValueError: the field, its value, and what is allowed.
    """
    positive = ("epsilon_steps", "beta_min", "spectral_bound")
    not_negative = ("tolerance", "pessimism", "value_weight_decay", "vector_noise")
    rates = ("learning_rate", "discriminator_learning_rate", "value_learning_rate", "generator_learning_rate")
    shares = ("gamma", "target_rate", "epsilon_start", "epsilon_end", "cell_noise")
    ranges = {
        **dict.fromkeys(positive, (math.ulp(0.0), math.inf, "above 0")),
        **dict.fromkeys(not_negative + rates, (0.0, math.inf, "at least 0")),
        **dict.fromkeys(shares, (0.0, 1.0, "in [0, 1]")),
    }
    for name, (low, high, allowed) in ranges.items():
        value = getattr(hparams, name)
        if not low <= value <= high:
            raise ValueError(f"{name} must be {allowed}, got {value:g}")
    if not hparams.beta_min <= hparams.beta_init <= hparams.beta_max:
        raise ValueError(f"beta_init must lie in [beta_min, beta_max], got {hparams.beta_init:g}")


@dataclass(frozen=True)
class Config:
    """Sizes and names; hashable and static, so that a change of any field compiles a new program.

    "Steps" are environment steps of all sources together unless a field says otherwise.

    Attributes:
      method: the curriculum's name in `apt_jax.curricula.METHODS`.
      envs_per_source: environments side by side in each source (target, generated).
      warmup_steps: steps collected by a uniformly random policy before any update (paper: 10,000).
      updates_per_step: policy updates per environment step (paper: 10).
      batch_size: transitions per policy update, drawn equally from the sources (paper: 128).
      episode_share: share of a policy update's transitions drawn by episode, in [0, 1]: short episodes, solved or
        fatal, then weigh as much as those that run into the horizon; the others are drawn uniformly (the paper names none: 0).
      n_step: rewards summed up before the Q-learning target bootstraps (the paper names none: 1).
      replay_steps: capacity of each source's replay, in steps of that source.
      replay_episodes: capacity of each source's ring of finished episodes.
      model_updates_per_step: updates of discriminator, values and generator per environment step (paper: 1).
      model_batch_size: rollouts per source in such an update (paper: 128).
      rollout_steps: transitions of each rollout that the discriminator sees in one update.
      recent_steps: discriminator and values learn from the latest so many steps of each source (paper: 10,000).
      relative_progress: whether V1 learns from logits centred and scaled to unit spread over the batch, so that progress weighs
        the same against return however sure the discriminator is (paper: no).
      blank_bias: head start of category 0 in the generator's initial grids, in standard deviations of the scores (paper: 0).
      value_ensemble: networks behind each of V1 and V2, whose estimate is their mean less `pessimism` deviations (paper: 1).
      noise_size: length of the generator's noise z.
      refresh_every: steps between updates of beta (paper: 500).
      return_window: episodes over which the generated return is averaged for beta, those of the warm-up left out (paper: 50).
      eval_every: steps between evaluations; one chunk of the compiled program (paper: 1,000).
      eval_episodes: episodes per evaluation (paper: 50).
      probe_tasks: fresh tasks proposed at each evaluation to judge the curriculum by.
    """

    method: str = "apt_gen"
    envs_per_source: int = 1
    warmup_steps: int = 10_000
    updates_per_step: int = 10
    batch_size: int = 128
    episode_share: float = 0.0
    n_step: int = 1
    replay_steps: int = 100_000
    replay_episodes: int = 10_000
    model_updates_per_step: float = 1.0
    model_batch_size: int = 128
    rollout_steps: int = 4
    recent_steps: int = 10_000
    relative_progress: bool = False
    blank_bias: float = 0.0
    value_ensemble: int = 1
    noise_size: int = 32
    refresh_every: int = 500
    return_window: int = 50
    eval_every: int = 1_000
    eval_episodes: int = 50
    probe_tasks: int = 64


PRESETS: dict[str, tuple[Config, HParams]] = {
    "paper": (Config(), HParams()),
    "fast": (
        Config(
            envs_per_source=5,
            updates_per_step=2,
            episode_share=0.5,
            model_updates_per_step=0.2,
            model_batch_size=64,
            recent_steps=20_000,
            relative_progress=True,
            blank_bias=2.0,
            value_ensemble=4,
        ),
        HParams(
            learning_rate=1e-3,
            generator_learning_rate=1e-3,
            gamma=0.97,
            value_weight_decay=10.0,
            cell_noise=0.03,
            vector_noise=0.05,
            spectral_bound=0.8,
        ),
    ),
}
"""Named starting points.

"paper" is the paper's algorithm and sizes.  "fast" learns in minutes on one core: a fifth of the updates, and the changes that
experiments/NOTES.md found to make the curriculum move.
"""
