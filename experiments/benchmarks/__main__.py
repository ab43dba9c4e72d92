"""Every benchmark, one after another: `python -m experiments.benchmarks`, or `make bench`.

Stop at any moment and repeat the command: what was measured at this commit, on this machine and with these packages is kept.
Nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from experiments.benchmarks import _measure
from experiments.errors import UsageError, exit_with

RUNS: Mapping[str, tuple[str, ...]] = {
    "training_step": ("training_step",),
    "training_step_manipulation": ("training_step", "--space", "manipulation"),
    "variants": ("variants",),
    "capacity": ("capacity",),
    "growth": ("growth",),
    "seeds": ("seeds",),
    "seeds_manipulation": ("seeds", "--space", "manipulation", "--seeds", "1", "5", "--devices", "1", "--cores", "1"),
    "methods": ("methods",),
    "environments": ("environments",),
    "training_throughput": ("training_throughput",),
    "dqn_peers": ("dqn_peers",),
    "manipulation": ("manipulation",),
    "manipulation_sawyer": ("manipulation", "--space", "manipulation_sawyer", "--envs", "1", "16", "64"),
    "sawyer": ("sawyer",),
    "compile_time": ("compile_time",),
    "compile_time_manipulation": ("compile_time", "--space", "manipulation"),
}
"""By the name of its results a script of this folder and its options."""

BUSY = 0.1
"""Share of the machine's time that others may take."""


@dataclass(frozen=True)
class Benchmarks:
    """Run benchmarks, each in a process of its own.

    Attributes:
      only: names of results, by default all.
      out: where NAME.json of each goes; by default what BENCHMARKS.md is made of, or runs/benchmarks if `quick`.
      quick: everything tiny, to see that the scripts run; the timings mean nothing.
    """

    only: tuple[str, ...] = ()
    out: Path | None = None
    quick: bool = False


def main() -> int:
    """The command line."""
    benchmarks = tyro.cli(Benchmarks, prog="python -m experiments.benchmarks", description=__doc__)
    if unknown := [name for name in benchmarks.only if name not in RUNS]:
        raise UsageError(f"--only must be among {', '.join(RUNS)}; got {', '.join(unknown)}")
    folder = benchmarks.out or Path("runs/benchmarks" if benchmarks.quick else "experiments/results/benchmarks")
    here = _measure.conditions()
    for name in benchmarks.only or RUNS:
        out = folder / f"{name}.json"
        if is_measured(out, here, benchmarks.quick):
            print(f"== {name}: kept, measured under the same conditions", flush=True)
            continue
        print(f"== {name}", flush=True)
        if (busy := _measure.busy_share()) > BUSY:
            print(
                f"warning: something else keeps the machine busy ({busy:.0%}); the timings will not be comparable", flush=True
            )
        script, *options = RUNS[name]
        command = [sys.executable, "-m", f"experiments.benchmarks.{script}", *options, "--out", str(out)]
        if code := subprocess.run([*command, "--quick"] if benchmarks.quick else command, check=False).returncode:
            return code
    return 0


def is_measured(out: Path, here: Mapping[str, Any], quick: bool) -> bool:
    """Whether a file has results of this size from this commit, machine and these packages."""
    commit = here["git_commit"]
    if not out.is_file() or not commit or commit.endswith("-dirty"):
        return False
    content = json.loads(out.read_text())
    same: bool = {name: content["environment"].get(name) for name in here} == here
    return same and content["settings"]["quick"] == quick


if __name__ == "__main__":
    exit_with(main)
