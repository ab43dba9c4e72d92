"""What a run is made of: static `Config` (sizes, names) and traced `HParams` (numbers)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, get_origin, get_type_hints

import flax.struct
import numpy as np

Covariance = Literal["full", "diagonal"]
"""Of ALP-GMM's components."""

BetaRule = Literal["doubling", "proportional"]
"""How beta follows the return of generated tasks."""


class Range(NamedTuple):
    """Numbers from `low` to `high`, and how to say so."""

    low: float
    high: float
    words: str


_SMALLEST, _LARGEST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)

Share = Annotated[float, Range(0.0, 1.0, "in [0, 1]")]
Finite = Annotated[float, Range(-_LARGEST, _LARGEST, "finite")]
NotNegative = Annotated[float, Range(0.0, _LARGEST, "finite and at least 0")]
PositiveFinite = Annotated[float, Range(_SMALLEST, _LARGEST, "finite and above 0")]
Positive = Annotated[float, Range(_SMALLEST, math.inf, "above 0")]
AtLeastZero = Annotated[float, Range(0.0, math.inf, "at least 0")]
AtLeastOne = Annotated[float, Range(1.0, math.inf, "at least 1")]
Count = Annotated[int, Range(1.0, math.inf, "at least 1")]


def ranges(kind: type) -> dict[str, Range]:
    """The ranges of a class's fields, as far as their types have one."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items() if get_origin(hint) is Annotated}


def check_ranges(numbers: HParams | Config) -> None:
    """Check every field that has a range, and that sizes are whole; for plain numbers, before they are traced.

    Raises:
      ValueError: the field, its value, and what is allowed.
    """
    for name, kind in get_type_hints(type(numbers)).items():
        if kind is int and not isinstance(getattr(numbers, name), int):
            raise ValueError(f"{name} must be a whole number, got {getattr(numbers, name)!r}")
    for name, (low, high, allowed) in ranges(type(numbers)).items():
        value = getattr(numbers, name)
        if not low <= value <= high:
            raise ValueError(f"{name} must be {allowed}, got {value:g}")


@flax.struct.dataclass
class HParams:
    """Numbers that may differ from lane to lane of one compiled program; every field is a float32 scalar once traced.

    Attributes:
      learning_rate: Adam step size of the policy, >= 0 (paper: 3e-4).
      discriminator_learning_rate: Adam step size of the discriminator, >= 0 (paper: 3e-4).
      value_learning_rate: Adam step size of both value networks, >= 0 (paper: 3e-4).
      generator_learning_rate: Adam step size of the generator, >= 0 (paper: 3e-4).
      gamma: discount of the Q-learning target, in [0, 1].
      target_rate: Polyak rate of the target network (not of the target task) per policy update, in [0, 1] (the paper
        names none).
      reset_every: environment steps between resets of the Q-network, replay kept, for as long as the kept policy's return on
        the target is not above 0, > 0 (the paper has none: `inf`).
      epsilon_start: exploration right after warm-up, in [0, 1].
      epsilon_end: exploration in the long run, in [0, 1].
      epsilon_steps: environment steps over which epsilon falls linearly, > 0.
      delta: wanted return of generated tasks (paper: 0.5).
      tolerance: half the width of the band around `delta` in which beta stays (paper: 0.1).
      beta_init: beta at the start.
      beta_min: lower bound of beta (paper: 1/8).
      beta_max: upper bound of beta (paper: 8).
      pessimism: standard deviations of the value ensemble taken off its mean, >= 0; nothing for an ensemble of one.
      value_weight_decay: decoupled weight decay of the value networks, biases included, per unit of their learning rate, >= 0.
      recency: how much discriminator and values prefer recent generated episodes (`replay.sample_rollouts`), >= 1; 1 draws
        uniformly from the window (paper).
      cell_noise: probability that a cell of a generated grid, or a row of a table, is played with a uniformly drawn category,
        in [0, 1] (paper: 0).
      vector_noise: standard deviation of the noise on generated vectors, as a share of their range, >= 0 (paper: 0).
      vector_prior: weight of the divergence of generated vectors from a fresh generator's, which keeps numbers off the ends of
        their range and different from task to task, >= 0 (paper: 0).
      spectral_bound: upper bound of the spectral norm, as estimated, of every kernel matrix of the discriminator, > 0 (paper:
        none).
      bonus_learning_rate: Adam step size of the networks behind an intrinsic reward, >= 0 (paper: 3e-4; RND's own 1e-4).
      icm_scale: factor on ICM's reward, >= 0 (its reference 0.01).
      rnd_scale: factor on RND's reward, >= 0 (its reference 1 beside rewards from the environment times 2).
      ride_scale: factor on RIDE's reward, >= 0 (its reference 0.1 to 0.5).
      alp_random_share: share of uniform tasks in ALP-GMM, in [0, 1] (its reference 0.2).
      alp_regularisation: added to the diagonal of ALP-GMM's covariances, where every block of a task parameter spans a length
        of 1, > 0 (scikit-learn 1e-6; below 1e-6 float32 has no Cholesky factors of 203 dimensions).
      goal_low: GoalGAN's lowest rate of success of a task worth proposing, in [0, 1] (its reference 0.25).
      goal_high: GoalGAN's highest rate of success of a task worth proposing, in [0, 1] (its reference 0.75).
      goal_old_share: share of earlier such tasks, proposed again, in [0, 1] (its reference 0.2).
      goal_noise: standard deviation of the noise on GoalGAN's tasks, whose numbers lie in [-1, 1], >= 0 (its reference 0.01).
      goal_learning_rate: RMSProp step size of GoalGAN's two networks, >= 0 (its reference 1e-3).
    """

    learning_rate: NotNegative = 3e-4
    discriminator_learning_rate: NotNegative = 3e-4
    value_learning_rate: NotNegative = 3e-4
    generator_learning_rate: NotNegative = 3e-4
    gamma: Share = 0.99
    target_rate: Share = 0.005
    reset_every: Positive = math.inf
    epsilon_start: Share = 1.0
    epsilon_end: Share = 0.1
    epsilon_steps: Positive = 1_000.0
    delta: Finite = 0.5
    tolerance: AtLeastZero = 0.1
    beta_init: PositiveFinite = 1.0
    beta_min: PositiveFinite = 0.125
    beta_max: PositiveFinite = 8.0
    pessimism: NotNegative = 1.0
    value_weight_decay: NotNegative = 0.0
    recency: AtLeastOne = 1.0
    cell_noise: Share = 0.0
    vector_noise: NotNegative = 0.0
    vector_prior: NotNegative = 0.0
    spectral_bound: Positive = math.inf
    bonus_learning_rate: NotNegative = 3e-4
    icm_scale: NotNegative = 0.01
    rnd_scale: NotNegative = 1.0
    ride_scale: NotNegative = 0.1
    alp_random_share: Share = 0.2
    alp_regularisation: PositiveFinite = 1e-5
    goal_low: Share = 0.25
    goal_high: Share = 0.75
    goal_old_share: Share = 0.2
    goal_noise: NotNegative = 0.01
    goal_learning_rate: NotNegative = 1e-3


def check_hparams(hparams: HParams) -> None:
    """Check the fields' ranges, and what must hold between them; for plain numbers, before they are traced.

    Raises:
      ValueError: the field, its value, and what is allowed.
    """
    check_ranges(hparams)
    if hparams.beta_min > hparams.beta_max:
        raise ValueError(f"beta_min must be at most beta_max={hparams.beta_max:g}, got {hparams.beta_min:g}")
    if not hparams.beta_min <= hparams.beta_init <= hparams.beta_max:
        raise ValueError(f"beta_init must lie in [beta_min, beta_max], got {hparams.beta_init:g}")
    shrink = hparams.value_learning_rate * hparams.value_weight_decay
    if shrink > 1.0:
        raise ValueError(f"value_learning_rate * value_weight_decay must be at most 1, got {shrink:g}")
    if hparams.goal_low > hparams.goal_high:
        raise ValueError(f"goal_low must be at most goal_high={hparams.goal_high:g}, got {hparams.goal_low:g}")


@dataclass(frozen=True)
class Config:
    """Sizes and names; hashable and static, so that a change of any field compiles a new program.

    "Steps" are environment steps of all sources together unless a field says otherwise.

    Attributes:
      method: a name in `apt_jax.methods.METHODS` or of a curriculum, or such a name and a bonus's, as in "apt_gen+rnd".
      envs_per_source: environments side by side in each source (target, generated).
      warmup_steps: steps collected by a uniformly random policy before any update (paper: 10,000).
      updates_per_step: policy updates per environment step (paper: 10).
      batch_size: transitions per policy update, drawn equally from the sources (paper: 128).
      success_share: share of a policy update's transitions drawn from successful episodes, in [0, 1], once a source has any,
        so that what is rare is not lost among steps that led nowhere (the paper names none: 0).
      n_step: rewards summed up before the Q-learning target bootstraps (the paper names none: 1).
      replay_steps: capacity of each source's replay, in steps of that source.
      replay_episodes: capacity of each source's ring of finished episodes.
      model_updates_per_step: rounds of updates of what is learned besides the policy (discriminator, values and generator; the
        networks of a bonus; GoalGAN's) per environment step (paper: 1).
      model_batch_size: rollouts per source in such a round (paper: 128); steps of all sources for a bonus, tasks for GoalGAN.
      rollout_steps: transitions of each rollout that the discriminator sees in one update.
      judge_parts: whether the discriminator classifies the parts of a rollout one by one, as PatchGAN does those of a picture:
        the initial observation and each transition by themselves; a rollout's score averages their probabilities, of which the
        initial observation's counts half.  Otherwise it classifies rollouts, by the average of their parts' logits (paper).
      recent_steps: how many of each source's latest steps discriminator and values learn from (paper: 10,000).
      relative_progress: whether V1 learns from logits centred and scaled to unit spread over the batch, so that progress weighs
        the same against return however sure the discriminator is (paper: no).
      blank_bias: head start of category 0 in the generator's initial grids, in standard deviations of the scores (paper: 0).
      value_ensemble: networks behind each of V1 and V2, whose estimate is their mean less `pessimism` deviations (paper: 1).
      noise_size: length of the generator's noise z.
      beta_rule: "doubling" doubles or halves beta at each update outside the band of `tolerance` around `delta` (paper);
        "proportional" sets it to beta_init * 2^((delta - return) / tolerance), within [beta_min, beta_max].
      alp_window: finished episodes that ALP-GMM fits its mixtures to; until there are so many, tasks are uniform (its reference
        250).
      alp_history: earlier episodes that ALP-GMM searches for the task nearest to each of these (its reference: all).
      alp_fit_every: steps between fits, a multiple of `refresh_every` (its reference: every 250 episodes).
      alp_covariance: "full", or "diagonal" where a task parameter has many more numbers than `alp_window` can tell.
      goal_rollouts: episodes by which GoalGAN judges a task (its reference 2).
      goal_tasks: latest tasks that its networks learn from (its reference 100).
      goal_memory: earlier good tasks that it may propose again.
      refresh_every: steps between updates of beta (paper: 500).
      return_window: episodes over which the generated return is averaged for beta, those of the warm-up left out (paper: 50).
      eval_every: steps between evaluations; one chunk of the compiled program (paper: 1,000).
      eval_episodes: episodes per evaluation (paper: 50).
      probe_tasks: fresh tasks proposed at each evaluation to judge the curriculum by.
    """

    method: str = "apt_gen"
    envs_per_source: Count = 1
    warmup_steps: int = 10_000
    updates_per_step: Count = 10
    batch_size: int = 128
    success_share: float = 0.0
    n_step: Count = 1
    replay_steps: int = 100_000
    replay_episodes: Count = 10_000
    model_updates_per_step: float = 1.0
    model_batch_size: Count = 128
    rollout_steps: Count = 4
    judge_parts: bool = False
    recent_steps: Count = 10_000
    relative_progress: bool = False
    blank_bias: Finite = 0.0
    value_ensemble: Count = 1
    noise_size: Count = 32
    beta_rule: BetaRule = "doubling"
    alp_window: Count = 250
    alp_history: Count = 2_000
    alp_fit_every: int = 5_000
    alp_covariance: Covariance = "full"
    goal_rollouts: Count = 2
    goal_tasks: Count = 100
    goal_memory: Count = 1_000
    refresh_every: Count = 500
    return_window: Count = 50
    eval_every: Count = 1_000
    eval_episodes: Count = 50
    probe_tasks: Count = 64


PRESETS: dict[str, tuple[Config, HParams]] = {
    "paper": (Config(), HParams()),
    "fast": (
        Config(
            envs_per_source=5,
            updates_per_step=2,
            success_share=0.25,
            model_updates_per_step=0.2,
            model_batch_size=64,
            rollout_steps=2,
            judge_parts=True,
            recent_steps=20_000,
            relative_progress=True,
            blank_bias=2.0,
            value_ensemble=4,
        ),
        HParams(
            learning_rate=1e-3,
            target_rate=0.02,
            reset_every=20_000.0,
            generator_learning_rate=7e-4,
            value_weight_decay=10.0,
            cell_noise=0.03,
            vector_noise=0.05,
            vector_prior=0.03,
            spectral_bound=0.8,
        ),
    ),
}
"""Named starting points.

"paper" is the paper's algorithm and sizes.  "fast" learns in minutes on one core: a fifth of the updates, and the changes that
experiments/NOTES.md found to make the curriculum move.
"""
