"""Train several methods on several targets, then compare them: `python -m experiments.compare --out DIR --methods dqn rnd`.

Every other option is one of `experiments.train` and holds for all runs.  Each method and target is a run directory of its own,
OUT/TARGET/METHOD.  Stop at any moment and repeat the command: what is finished is kept, what was stopped goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from apt_jax.methods import METHODS
from experiments import plots, report, settings
from experiments.errors import UsageError, exit_with
from experiments.problem import make_problem
from experiments.settings import Experiment, Session
from experiments.train import start_jax, train

OWN = ("run-dir", "resume", "method", "target", "target-file", "config.method")
"""Options of `experiments.train` that are decided here."""


@dataclass(frozen=True)
class Compare:
    """Compare methods on targets; all other options are those of experiments.train.

    Attributes:
      out: where the runs, `comparison.md` and `comparison.png` go.
      methods: what to compare, by default every method of the paper; with a bonus added as in "apt_gen+rnd".
      targets: names of targets, or files that describe them.
    """

    out: Path
    methods: tuple[str, ...] = tuple(METHODS)
    targets: tuple[str, ...] = ("A",)


def main() -> int:
    """The command line."""
    comparison, options = tyro.cli(Compare, prog="python -m experiments.compare", return_unknown_args=True)
    runs = plan(comparison, options)
    start_jax(runs[0][1])
    for experiment, _ in runs:  # what is wrong with the last is told before the first begins
        make_problem(experiment)
    for experiment, session in runs:
        code = train(experiment, session)
        if code:
            print("to go on with the comparison: repeat the command")
            return code
    print(summarise(comparison))
    return 0


def plan(comparison: Compare, options: Sequence[str]) -> list[tuple[Experiment, Session]]:
    """Every run to be made or gone on with, target by target.

    Raises:
      UsageError: an option that is decided here, something missing, or what `experiments.train` refuses.
    """
    for option in options:
        name = option.split("=")[0].lstrip("-").replace("_", "-")
        if option.startswith("--") and name in OWN:
            raise UsageError(f"--{name} is decided for every run; say --methods, --targets and --out")
    if not comparison.methods or not comparison.targets:
        raise UsageError("--methods and --targets need at least one name each")
    paths = [run_path(comparison, method, target) for target in comparison.targets for method in comparison.methods]
    if len(set(paths)) != len(paths):
        raise UsageError("--methods and --targets need different names")
    runs = []
    for target in comparison.targets:
        for method in comparison.methods:
            path = run_path(comparison, method, target)
            resume = ["--resume"] if (path / "config.json").is_file() else []
            words = ["--run-dir", str(path), "--target", target, "--method", method, *resume, *options]
            runs.append(settings.parse(words))
    return runs


def run_path(comparison: Compare, method: str, target: str) -> Path:
    """Where a run lives."""
    return comparison.out / Path(target).stem / method


def summarise(comparison: Compare) -> str:
    """Writes comparison.md and comparison.png, for finished runs; returns the text."""
    panels = {
        Path(target).stem: report.read([run_path(comparison, method, target) for method in comparison.methods])
        for target in comparison.targets
    }
    text = "\n\n".join(f"Target {target}:\n\n{report.table(runs)}" for target, runs in panels.items())
    (comparison.out / "comparison.md").write_text(text + "\n")
    plots.comparison(comparison.out / "comparison.png", panels)
    return text


if __name__ == "__main__":
    exit_with(main)
