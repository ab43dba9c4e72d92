"""Score what a run has learned on any targets of its space: `python -m experiments.evaluate --run-dir DIR --target A B C`."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from apt_jax.evaluation import Outcome
from experiments import episodes, film, runtime, settings
from experiments.errors import UsageError, check_output, exit_with
from experiments.problem import import_plugins, make_problem
from experiments.runner import load_lanes


@dataclass(frozen=True)
class Args:
    """Score the kept policy of every seed of a run on any targets of its space.

    Attributes:
      run_dir: a directory that experiments.train wrote.
      target: names of targets, or files that describe them; by default the one trained on.
      episodes: greedy episodes per lane and target.
      seed: random seed of the episodes' initial states.
      csv: where to put the scores, a row per target and lane.
      gif: where to put a film of the best lane, of one target.
      robot: have the Sawyer arm play the film's episode, in Manipulation (see experiments.film).
    """

    run_dir: Path
    target: tuple[str, ...] = ()
    episodes: int = 50
    seed: int = 0
    csv: Path | None = None
    gif: Path | None = None
    robot: bool = False


class Score(NamedTuple):
    """Means over a lane's episodes."""

    target: str
    lane: str
    episode_return: float
    success: float
    length: float


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.evaluate")
    runtime.setup()
    evaluate(args)
    return 0


def evaluate(args: Args) -> None:
    """Prints return and success of every lane on every target."""
    check(args)
    experiment = settings.load(args.run_dir)
    import_plugins(experiment.plugins)
    if args.robot:
        film.check_robot(experiment.space)
    experiments = [on_target(experiment, target) for target in args.target] or [experiment]
    problems = [make_problem(other) for other in experiments]
    trainer = problems[0].trainer
    states, clock, _ = load_lanes(args.run_dir, experiment, trainer)
    policies = jax.device_put(states.policy, jax.local_devices()[0])
    score = episodes.make_score(trainer, args.episodes)
    scores = []
    for other, problem in zip(experiments, problems, strict=True):
        key_score, key_film = jax.random.split(jax.random.key(args.seed))
        outcome = jax.device_get(score(policies, problem.target, key_score))
        own = lane_scores(settings.target_name(other), [lane.name for lane in experiment.lanes], outcome)
        _print(own, f"{own[0].target} after {int(clock.env_steps):,} steps")
        scores += own
        if args.gif:
            best = int(np.argmax([each.episode_return for each in own]))
            policy = jax.tree.map(lambda x: x[best], policies)  # noqa: B023
            episode = episodes.greedy(problem.space, trainer, policy, problem.target, key_film)
            film.save(args.gif, problem.space, problem.target, episode, robot=args.robot)
    if args.csv:
        with args.csv.open("w", newline="") as file:
            csv.writer(file).writerows([Score._fields, *scores])


def check(args: Args) -> None:
    """Raises a `UsageError` for options that cannot be, before the work."""
    if args.episodes < 1:
        raise UsageError(f"--episodes must be at least 1, got {args.episodes}")
    if args.robot and not args.gif:
        raise UsageError("--robot plays the film's episode: say where to put it, --gif FILE")
    if args.gif and len(args.target) > 1:
        raise UsageError(f"--gif films one --target, got {', '.join(args.target)}")
    settings.check_seed(args.seed)
    check_output(args.gif, (".gif",))
    check_output(args.csv, (".csv",))


def on_target(experiment: settings.Experiment, target: str) -> settings.Experiment:
    """The same with another target."""
    return dataclasses.replace(experiment, target=target, target_file=settings.target_path(experiment.space, target))


def lane_scores(target: str, lanes: Sequence[str], outcome: Outcome) -> list[Score]:
    """Every lane's, of an outcome with leaves [L, episodes]."""
    return [Score(target, lane, *(float(np.mean(values[i])) for values in outcome)) for i, lane in enumerate(lanes)]


def _print(scores: Sequence[Score], title: str) -> None:
    table = Table("", "return", "success", "steps", title=title)
    for _, lane, *values in scores:
        table.add_row(lane, *(f"{value:.3f}" for value in values))
    table.add_section()
    table.add_row("mean", *(f"{np.mean(values):.3f}" for values in list(zip(*scores, strict=True))[2:]))
    Console().print(table)


if __name__ == "__main__":
    exit_with(main)
