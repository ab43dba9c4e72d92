"""Compare finished runs in a table and a figure, every seed shown: `python -m experiments.report --runs DIR [DIR ...]`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Int

from experiments import markdown, plots, run_dir
from experiments.aggregates import iqm, iqm_interval
from experiments.errors import PICTURES, UsageError, check_output, exit_with

SOLVED = 0.9
"""Target return from which a task counts as solved."""

HEADER = (
    "run",
    "steps",
    "kept return by seed (mean ± deviation)",
    "interquartile mean (95 % interval)",
    "before the restore rule",
    f"first steps above {SOLVED:g}",
)


@dataclass(frozen=True)
class Report:
    """Compare runs on the same target.

    Attributes:
      runs: run directories; a run is called by its directory's name, and each combination of swept hyper-parameters is one.
      figure: where to draw the metrics of every seed; not drawn by default.
      metrics: columns of metrics.csv that the figure shows, a panel each.
    """

    runs: tuple[Path, ...]
    figure: Path | None = None
    metrics: tuple[str, ...] = ("target_return",)


def main() -> int:
    """The command line."""
    report = tyro.cli(Report, prog="python -m experiments.report", description=__doc__)
    if not report.runs:
        raise UsageError("--runs needs at least one directory")
    runs = read(report.runs)
    known = {metric for _, curves in runs.values() for metric in curves}
    if not report.metrics or not known.issuperset(report.metrics):
        raise UsageError(f"--metrics must be among {', '.join(sorted(known))}; got {', '.join(report.metrics) or 'none'}")
    check_output(report.figure, PICTURES)
    print(table(runs))
    if report.figure:
        plots.comparison(report.figure, {"": runs}, metrics=report.metrics)
    return 0


def read(paths: Sequence[Path]) -> dict[str, plots.Run]:
    """Metrics of every run and setting, by name.

    Raises:
      UsageError: no evaluation yet, or two runs of one name.
    """
    names = [path.name for path in paths]
    if twice := {name for name in names if names.count(name) > 1}:
        raise UsageError(f"--runs are called by the names of their directories, which must differ: {', '.join(sorted(twice))}")
    return {name: run for path in paths for name, run in read_parts(path.name, [path]).items()}


def read_parts(name: str, paths: Sequence[Path]) -> dict[str, plots.Run]:
    """Like `read`, for one run whose seeds are spread over several directories.

    Raises:
      UsageError: no evaluation yet, or directories that do not make one run.
    """
    parts = [run_dir.read_settings(path) for path in paths]
    runs = {}
    for setting, (env_steps, first) in parts[0].items():
        same = [part[setting] for part in parts if setting in part and np.array_equal(part[setting][0], env_steps)]
        curves = {metric: np.concatenate([curves[metric] for _, curves in same]) for metric in first}
        if len(same) != len(parts) or len(set(curves["seed"][:, 0])) != len(curves["seed"]):
            listed = ", ".join(str(path) for path in paths)
            raise UsageError(f"not the seeds of one run, each once and up to the same step: {listed}")
        runs[f"{name}, {setting}" if setting else name] = env_steps, curves
    return runs


def table(runs: dict[str, plots.Run]) -> str:
    """A Markdown table with a line per run."""
    return markdown.table(HEADER, [cells(name, env_steps, curves) for name, (env_steps, curves) in runs.items()])


def cells(name: str, env_steps: Int[np.ndarray, "T"], curves: run_dir.Curves) -> tuple[str, ...]:
    """One line of the table; a dash where a seed never got there."""
    final, raw = curves["target_return"][:, -1], curves["target_return_raw"][:, -1]
    firsts = [first_above(env_steps, values) for values in curves["target_return_raw"]]
    low, high = iqm_interval(final)
    return (
        name,
        f"{env_steps[-1]:,}",
        f"{_numbers(final)} ({final.mean():.2f} ± {final.std():.2f})",
        f"{iqm(final):.2f} ({low:.2f} to {high:.2f})",
        _numbers(raw),
        " ".join("-" if step is None else f"{step / 1000:g}k" for step in firsts),
    )


def first_above(env_steps: Int[np.ndarray, "T"], values: Float[np.ndarray, "T"]) -> int | None:
    """The first evaluation at which a seed solved the target, None if it never did."""
    solved = np.flatnonzero(values > SOLVED)
    return int(env_steps[solved[0]]) if solved.size else None


def _numbers(values: Float[np.ndarray, "S"]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


if __name__ == "__main__":
    exit_with(main)
