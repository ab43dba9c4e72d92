"""Does one set of runs solve more seeds than another, or sooner: `python -m experiments.contrast --first DIR --second DIR`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float
from scipy import stats

from experiments import markdown, plots, report, run_dir
from experiments.errors import UsageError, exit_with

HEADER = ("first", "second", "to steps", "solved", "p (solved)", "p (sooner)")

DEALS = 200_000
"""Ways to deal the seeds out that the test of times tries: all of them for two times ten, else a sample of this size."""


@dataclass(frozen=True)
class Contrast:
    """Test two sets of runs against each other, the seeds of each set together; nothing is corrected for several tests.

    Two tests, both two-sided: Fisher's exact test of how many seeds are solved, and a permutation test of the Mann-Whitney
    statistic of the evaluations at which they first are, where unsolved seeds share the last rank.  Target returns above 0.9
    count as solved.

    Attributes:
      first: run directories.
      second: run directories.
      env_steps: what happened later does not count; by default the steps that all runs have made.
    """

    first: tuple[Path, ...]
    second: tuple[Path, ...]
    env_steps: int | None = None


def main() -> int:
    """The command line."""
    contrast = tyro.cli(Contrast, prog="python -m experiments.contrast")
    print(markdown.table(HEADER, [cells(contrast.first, contrast.second, contrast.env_steps)]))
    return 0


def cells(first: Sequence[Path], second: Sequence[Path], env_steps: int | None = None) -> tuple[str, ...]:
    """One line of the table.

    Raises:
      UsageError: a set without runs, a sweep, a run twice, sets on different targets, or a run that has not come to `env_steps`
        with a seed unsolved.
    """
    if not first or not second:
        raise UsageError("--first and --second need at least one directory each")
    if env_steps is not None and env_steps < 1:
        raise UsageError(f"--env-steps must be at least 1, got {env_steps}")
    paths = [*first, *second]
    check_comparable(first, second)
    runs = [run_dir.read_metrics(path) for path in paths]
    until = min(int(steps[-1]) for steps, _ in runs) if env_steps is None else env_steps
    for path, (steps, curves) in zip(paths, runs, strict=True):
        if steps[-1] < until and np.isinf(solving_times([(steps, curves)], until)).any():
            raise UsageError(f"--env-steps {until} is more than {path} has made with a seed unsolved: {steps[-1]}")
    times = [solving_times(own, until) for own in (runs[: len(first)], runs[len(first) :])]
    solved = " and ".join(f"{np.isfinite(own).sum()} of {own.size}" for own in times)
    names = [", ".join(path.name for path in own) for own in (first, second)]
    return (*names, f"{until:,}", solved, f"{p_solved(*times):.2g}", f"{p_sooner(*times):.2g}")


def check_comparable(first: Sequence[Path], second: Sequence[Path]) -> None:
    """Raises a `UsageError` unless both sets are on the same targets, no run is there twice, and none is a sweep."""
    targets = []
    for paths in (first, second):
        configs = [run_dir.read_config(path) for path in paths]
        for path in paths:
            if len(settings := run_dir.read_settings(path)) > 1:
                raise UsageError(f"{path} is a sweep of {len(settings)} settings, which are no seeds")
        seeds = [(json.dumps({**config, "seeds": seed, "env_steps": 0})) for config in configs for seed in config["seeds"]]
        if len(set(seeds)) < len(seeds):
            raise UsageError(f"the same seed of the same run is there twice: {', '.join(map(str, paths))}")
        targets.append({(config["space"], config["target"]) for config in configs})
    if targets[0] != targets[1]:
        named = (", ".join(sorted(f"{target} of {space}" for space, target in own)) for own in targets)
        raise UsageError(f"--first and --second need the same targets, got {' beside '.join(named)}")


def solving_times(runs: Sequence[plots.Run], until: int) -> Float[np.ndarray, "S"]:
    """The first evaluation, in environment steps, at which each seed solved the target; infinite if none up to `until` did."""
    firsts = [report.first_above(steps, values) for steps, curves in runs for values in curves["target_return_raw"]]
    return np.array([np.inf if first is None or first > until else float(first) for first in firsts])


def p_solved(first: Float[np.ndarray, "A"], second: Float[np.ndarray, "B"]) -> float:
    """Fisher's exact test, two-sided, of how many of the times are finite."""
    table = [[np.isfinite(times).sum(), np.isinf(times).sum()] for times in (first, second)]
    return float(stats.fisher_exact(table).pvalue)


def p_sooner(first: Float[np.ndarray, "A"], second: Float[np.ndarray, "B"]) -> float:
    """Mann-Whitney test, two-sided, of which times are shorter, ties sharing their rank: exact, or sampled beyond `DEALS`."""
    ranks = stats.rankdata(np.concatenate([first, second]))
    result = stats.permutation_test(
        (ranks[: first.size], ranks[first.size :]),
        lambda own, other, axis: own.sum(axis=axis),
        vectorized=True,
        n_resamples=DEALS,
        rng=np.random.default_rng(0),
    )
    return float(result.pvalue)


if __name__ == "__main__":
    exit_with(main)
