"""Compare finished runs in a table and a figure, every seed shown: `python -m experiments.report --runs DIR [DIR ...]`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Int

from experiments import plots, run_dir
from experiments.errors import exit_with

SOLVED = 0.9
"""Target return from which a task counts as solved."""


@dataclass(frozen=True)
class Report:
    """Compare runs on the same target.

    Attributes:
      runs: run directories; a run is called by its directory's name.
      figure: where to draw the target return of every seed; not drawn by default.
    """

    runs: tuple[Path, ...]
    figure: Path | None = None


def main() -> int:
    """The command line."""
    report = tyro.cli(Report, prog="python -m experiments.report", description=__doc__)
    runs = {path.name: run_dir.read_metrics(path) for path in report.runs}
    print("| run | steps | final return by seed (mean ± deviation) | before the restore rule | first steps above 0.9 |")
    print("|---|---|---|---|---|")
    for name, (env_steps, curves) in runs.items():
        print(row(name, env_steps, curves))
    if report.figure:
        report.figure.parent.mkdir(parents=True, exist_ok=True)
        plots.comparison(report.figure, runs)
    return 0


def row(name: str, env_steps: Int[np.ndarray, "T"], curves: run_dir.Curves) -> str:
    """One line of the table; a dash where a seed never got there."""
    final, raw = curves["target_return"][:, -1], curves["target_return_raw"][:, -1]
    firsts = [first_above(env_steps, values) for values in curves["target_return_raw"]]
    cells = (
        name,
        f"{env_steps[-1]:,}",
        f"{_numbers(final)} ({final.mean():.2f} ± {final.std():.2f})",
        _numbers(raw),
        " ".join("-" if step is None else f"{step / 1000:g}k" for step in firsts),
    )
    return f"| {' | '.join(cells)} |"


def first_above(env_steps: Int[np.ndarray, "T"], values: Float[np.ndarray, "T"]) -> int | None:
    """The first evaluation at which a seed solved the target, None if it never did."""
    solved = np.flatnonzero(values > SOLVED)
    return int(env_steps[solved[0]]) if solved.size else None


def _numbers(values: Float[np.ndarray, "S"]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


if __name__ == "__main__":
    exit_with(main)
