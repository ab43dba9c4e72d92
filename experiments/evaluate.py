"""Score what a run has learned on any target of its space: `python -m experiments.evaluate --run-dir DIR --target B`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from apt_jax.evaluation import Outcome
from experiments import episodes, film, runtime, settings
from experiments.errors import UsageError, exit_with, make_folder
from experiments.problem import import_plugins, make_problem
from experiments.runner import load_lanes


@dataclass(frozen=True)
class Args:
    """Score the kept policy of every seed of a run on any target of its space.

    Attributes:
      run_dir: a directory that experiments.train wrote.
      target: a target's name, or a file that describes one; by default the one trained on.
      episodes: greedy episodes per lane.
      seed: random seed of the episodes' initial states.
      gif: where to put a film of the best lane.
      robot: have the Sawyer arm play the film's episode, in Manipulation (see experiments.film).
    """

    run_dir: Path
    target: str | None = None
    episodes: int = 50
    seed: int = 0
    gif: Path | None = None
    robot: bool = False


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.evaluate")
    runtime.setup()
    evaluate(args)
    return 0


def evaluate(args: Args) -> None:
    """Prints return and success of every lane."""
    if args.episodes < 1:
        raise UsageError(f"--episodes must be at least 1, got {args.episodes}")
    if args.robot and not args.gif:
        raise UsageError("--robot plays the film's episode: say where to put it, --gif FILE")
    make_folder(args.gif)
    experiment = settings.load(args.run_dir)
    import_plugins(experiment.plugins)
    if args.robot:
        film.check_robot(experiment.space)
    if args.target:
        file = settings.target_path(experiment.space, args.target)
        experiment = dataclasses.replace(experiment, target=args.target, target_file=file)
    problem = make_problem(experiment)
    states, clock, _ = load_lanes(args.run_dir, experiment, problem.trainer)
    policies = jax.device_put(states.policy, jax.local_devices()[0])
    key_score, key_film = jax.random.split(jax.random.key(args.seed))
    outcome = episodes.score(problem.trainer, policies, problem.target, episodes=args.episodes, key=key_score)
    names = [lane.name for lane in experiment.lanes]
    _print(
        names,
        outcome,
        f"{settings.target_name(experiment)} after {int(clock.env_steps):,} steps",
    )
    if args.gif:
        best = int(np.argmax(outcome.episode_return.mean(axis=1)))
        policy = jax.tree.map(lambda x: x[best], policies)
        episode = episodes.play(problem.space, problem.target, lambda obs, _: problem.trainer.act(policy, obs), key_film)
        film.save(args.gif, problem.space, problem.target, episode, robot=args.robot)


def _print(lanes: Sequence[str], outcome: Outcome, title: str) -> None:
    table = Table("", "return", "success", "steps", title=title)
    for lane, *values in zip(lanes, outcome.episode_return, outcome.success, outcome.length, strict=True):
        table.add_row(lane, *(f"{np.mean(value):.3f}" for value in values))
    table.add_section()
    table.add_row("mean", *(f"{np.mean(values):.3f}" for values in outcome))
    Console().print(table)


if __name__ == "__main__":
    exit_with(main)
