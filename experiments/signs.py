"""How a curriculum unfolded, seed by seed, in a table: `python -m experiments.signs --runs DIR [DIR ...]`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Int

from apt_jax.config import HParams
from experiments import markdown, run_dir, settings
from experiments.errors import UsageError, exit_with

HEADER = (
    "run",
    "seed",
    "generated return, mean (10th to 90th percentile)",
    "beta at its lower, upper bound",
    "shortest solution",
    "feasible",
    "tile entropy",
    "distance of the goal",
    "V1's correlation",
    "V2's correlation",
    "V2's bias, policy frozen",
    "V2's bias, policy learning (root mean square; correlation over time)",
)


@dataclass(frozen=True)
class Signs:
    """Print the curriculum's own signs.

    What changes over training is shown at each quarter of it, as the mean of the five evaluations up to there.
    V2's bias is taken twice: of its estimate of fresh tasks less their return under the policy frozen as it is at the
    evaluation, and of what the generator believes it earns (V2 of its proposals, before exploration and less `pessimism`) less
    what generated episodes do return, in which the policy goes on learning.

    Attributes:
      runs: directories of runs of apt_gen or its ablations; a run is called by its directory's name.
      after: means are over the evaluations after so many environment steps.
    """

    runs: tuple[Path, ...]
    after: int = 20_000


def main() -> int:
    """The command line."""
    signs = tyro.cli(Signs, prog="python -m experiments.signs", description=__doc__)
    if not signs.runs:
        raise UsageError("--runs needs at least one directory")
    print(table(signs.runs, after=signs.after))
    return 0


def table(runs: Sequence[Path], *, after: int = Signs.after) -> str:
    """A Markdown table with a line per seed and setting.

    Raises:
      UsageError: no evaluation yet, a run of another method, or one that ended before `after`.
    """
    rows = []
    for path in runs:
        experiment = settings.load(path)
        env_steps, curves = run_dir.read_metrics(path)
        if "beta" not in curves:
            raise UsageError(
                f"{path} is a run of {experiment.config.method}: signs reads what only apt_gen and its ablations write"
            )
        if env_steps[-1] <= after:
            raise UsageError(f"--after must be below the {env_steps[-1]:,} steps of {path}, got {after:,}")
        for i, lane in enumerate(experiment.lanes):
            own = {name: values[i] for name, values in curves.items()}
            rows.append(cells(path.name, lane.name.removeprefix("seed "), env_steps, own, after, lane.hparams))
    return markdown.table(HEADER, rows)


def cells(
    name: str,
    lane: str,
    env_steps: Int[np.ndarray, "T"],
    curves: dict[str, Float[np.ndarray, "T"]],
    after: int,
    hparams: HParams,
) -> tuple[str, ...]:
    """One line of the table; a metric that the task space lacks is a dash."""
    late = env_steps > after
    returns = curves["generated_episode_return"][late]
    low, high = np.nanpercentile(returns, [10, 90])
    beta = curves["beta"][late]
    bounds = [np.mean(beta == getattr(hparams, bound)) for bound in ("beta_min", "beta_max")]
    return (
        name,
        lane,
        f"{np.nanmean(returns):.2f} ({low:.2f} to {high:.2f})",
        ", ".join(f"{share:.0%}" for share in bounds),
        over_time(env_steps, curves.get("probe_solution_length"), 1),
        over_time(env_steps, curves.get("probe_feasible"), 2),
        over_time(env_steps, curves.get("probe_entropy_tiles"), 2),
        over_time(env_steps, curves.get("probe_goal_distance"), 1),
        *(f"{np.nanmean(curves[name][late]):.2f}" for name in ("v1_correlation", "v2_correlation")),
        f"{np.nanmean(curves['v2_bias'][late]):+.2f}",
        error(curves["generator_return"][late], returns),
    )


def error(expected: Float[np.ndarray, "T"], returned: Float[np.ndarray, "T"]) -> str:
    """Mean of what was expected less what was returned, the root of its mean square, and the correlation of the two."""
    known = np.isfinite(expected) & np.isfinite(returned)
    expected, returned = expected[known], returned[known]
    difference = expected - returned
    # A curve that does not move has no correlation.
    correlation = np.corrcoef(expected, returned)[0, 1] if expected.std() > 0 and returned.std() > 0 else np.nan
    return f"{difference.mean():+.2f} ({np.sqrt((difference**2).mean()):.2f}; {correlation:.2f})"


def over_time(env_steps: Int[np.ndarray, "T"], values: Float[np.ndarray, "T"] | None, digits: int) -> str:
    """A curve at each quarter of the steps, a dash where nothing was known yet."""
    if values is None:
        return "-"
    windows = [values[env_steps * 4 <= env_steps[-1] * quarter][-5:] for quarter in (1, 2, 3, 4)]
    means = [np.mean(window[np.isfinite(window)]) if np.isfinite(window).any() else np.nan for window in windows]
    return " ".join("-" if np.isnan(mean) else f"{mean:.{digits}f}" for mean in means)


if __name__ == "__main__":
    exit_with(main)
