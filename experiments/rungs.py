"""What the models and the policy of an APT-Gen run make of a ladder of tasks, from trivial to the target.

    python -m experiments.rungs --run-dir DIR

The tasks are those of `experiments.ladder`.  If progress leads to the target, the discriminator's logit and V1 rise along the
ladder; if tasks are generated at the border of what the policy can do, V2 falls as its return does.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float, Int, Key
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy import stats

from apt_jax import evaluation, learner
from apt_jax.config import HParams
from apt_jax.curricula import apt_gen
from apt_jax.curricula.apt_gen import AptGenState
from apt_jax.curricula.apt_gen_objectives import make_objectives
from apt_jax.networks import QNetwork
from apt_jax.specs import Obs, Params
from apt_jax.trainer import Trainer
from experiments import markdown, runtime, settings
from experiments.errors import PICTURES, UsageError, check_output, exit_with
from experiments.ladder import Ladder, build
from experiments.problem import check_apt_gen, make_problem
from experiments.runner import load_lanes

STEPS_SEEN = 16
"""Transitions of each rollout that its logit is taken from."""


@dataclass(frozen=True)
class Args:
    """Play a ladder of tasks to a run's target, and ask its models about them.

    Attributes:
      run_dir: a run of APT-Gen on Grid-World.
      tasks: played per rung.
      seed: random seed of the choice of tasks and of the policy's exploration.
      figure: where to draw the curves, if anywhere.
    """

    run_dir: Path
    tasks: int = 24
    seed: int = 0
    figure: Path | None = None


class Judgement(NamedTuple):
    """Of every task of a ladder, by lane: leaves [lanes, rungs, tasks].

    Attributes:
      logit: the discriminator's, of the rollout.
      progress: what V1 says of the task.
      value: what V2 says of it.
      episode_return: of the averaged policy, exploring as much as it does in training.
      success: whether it solved the task.
    """

    logit: Float[Array, "..."]
    progress: Float[Array, "..."]
    value: Float[Array, "..."]
    episode_return: Float[Array, "..."]
    success: Bool[Array, "..."]


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.rungs", description=__doc__)
    check_output(args.figure, PICTURES)
    settings.check_seed(args.seed)
    runtime.setup()
    if args.tasks < 1:
        raise UsageError(f"--tasks must be at least 1, got {args.tasks}")
    experiment = settings.load(args.run_dir)
    if experiment.space != "grid_world":
        raise UsageError(f"{args.run_dir} is no run on grid_world but on {experiment.space}")
    problem = make_problem(experiment)
    check_apt_gen(problem.trainer, args.run_dir)
    states, clock, hparams = load_lanes(args.run_dir, experiment, problem.trainer)
    ladder = build(problem.target)
    lanes = len(experiment.lanes)
    policies, curricula = jax.device_put((states.policy, states.curriculum), jax.local_devices()[0])
    judged = judge(
        problem.trainer, policies, curricula, hparams, choose(ladder, args.tasks, args.seed), jax.random.key(args.seed)
    )
    judged = jax.tree.map(lambda x: np.asarray(x).reshape(lanes, len(ladder.steps), args.tasks), judged)
    print(f"{args.run_dir} after {int(clock.env_steps):,} steps; means over lanes and tasks\n")
    print(table(ladder, judged), end="\n\n")
    print(correlations([lane.name for lane in experiment.lanes], ladder, judged))
    if args.figure:
        draw(args.figure, ladder, judged)
    return 0


def choose(ladder: Ladder, tasks: int, seed: int) -> Params:
    """So many tasks of each rung, drawn with replacement: leaves [rungs * tasks, ...]."""
    rng = np.random.default_rng(seed)
    chosen = rng.integers(ladder.first[:-1, None], ladder.first[1:, None], (len(ladder.steps), tasks))
    return jax.tree.map(lambda x: x[chosen.reshape(-1)], ladder.w)


def judge(
    trainer: Trainer, policies: Any, curricula: AptGenState, hparams: HParams, w: Params, key: Key[Array, ""]
) -> Judgement:
    """Plays tasks w (leaves [n, ...]) by the policy of every lane and asks its models: leaves [L, n]; consumes `key`."""
    space = trainer.space
    network = QNetwork(space.obs_spec, space.num_actions)
    objectives = make_objectives(space, trainer.config)
    key_play, key_steps = jax.random.split(key)

    def of_lane(policy: Any, curriculum: AptGenState, hparams: HParams, w: Params) -> Judgement:
        def act(obs: Obs, key: Key[Array, ""]) -> Int[Array, "n"]:
            return learner.epsilon_greedy(network, policy, obs, key, hparams.epsilon_end)

        outcome, transitions = evaluation.play(space, jax.vmap(space.instantiate)(w), act, key_play)
        rollouts = evaluation.sample_rollouts(w, outcome, transitions, key_steps, steps=STEPS_SEEN)
        said = apt_gen.judge(objectives, curriculum, rollouts, hparams)
        return Judgement(*said, episode_return=outcome.episode_return, success=outcome.success)

    return jax.jit(jax.vmap(of_lane, in_axes=(0, 0, 0, None)))(policies, curricula, hparams, w)


def table(ladder: Ladder, judged: Judgement) -> str:
    """A line per rung."""
    header = ("steps", "D's logit", "of solved tasks", "of failed tasks", "V1", "V2", "return", "solved")
    rows = []
    for rung, steps in enumerate(ladder.steps):
        logit, progress, value, episode_return, success = (np.asarray(x[:, rung]) for x in judged)
        cells = [mean(x) for x in (logit, logit[success], logit[~success], progress, value, episode_return, success)]
        rows.append((f"{steps:.0f}", *cells))
    return markdown.table(header, rows)


def mean(values: Float[np.ndarray, "..."]) -> str:
    """With two digits, a dash for none."""
    return f"{values.mean():.2f}" if values.size else "-"


def correlations(names: list[str], ladder: Ladder, judged: Judgement) -> str:
    """Rank correlations over the tasks of each lane."""

    def rank(a: Float[np.ndarray, "..."], b: Float[np.ndarray, "..."]) -> str:
        return f"{stats.spearmanr(a.reshape(-1), b.reshape(-1)).statistic:+.2f}"

    header = ("lane", "D with the rung", "V1 with the rung", "V1 with D", "V2 with the return")
    rows = []
    for name, logit, progress, value, episode_return, _ in zip(names, *judged, strict=True):
        rung = np.broadcast_to(ladder.steps[:, None], logit.shape)
        pairs = ((logit, rung), (progress, rung), (progress, logit), (value, episode_return))
        rows.append((name, *(rank(*pair) for pair in pairs)))
    return markdown.table(header, rows)


def draw(file: Path, ladder: Ladder, judged: Judgement) -> None:
    """Every lane thin, their mean thick."""
    titles = ("D's logit", "V1", "V2", "Return", "Solved")
    figure = Figure(figsize=(3.4 * len(titles), 3.2), layout="constrained")
    for axes, title, values in zip(figure.subplots(1, len(titles)), titles, judged, strict=True):
        by_lane = values.mean(axis=2)
        axes.plot(ladder.steps, by_lane.T, linewidth=0.8, alpha=0.5)
        axes.plot(ladder.steps, by_lane.mean(axis=0), color="black", linewidth=2)
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel("steps of the shortest solution")
    thin, thick = Line2D([], [], color="C0", linewidth=0.8), Line2D([], [], color="black", linewidth=2)
    figure.legend([thin, thick], ["each lane", "mean"], loc="outside lower center", ncols=2, fontsize="small")
    figure.savefig(file, dpi=150)


if __name__ == "__main__":
    exit_with(main)
