"""Every benchmark, one after another: `python -m experiments.benchmarks`, or `make bench`.

Stop at any moment and repeat the command: what was measured at this commit is kept.  Nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import tyro

from experiments import runtime
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


@dataclass(frozen=True)
class Benchmarks:
    """Run benchmarks, each in a process of its own.

    Attributes:
      only: names of results, by default all.
      out: where NAME.json of each goes.
      quick: everything tiny, to see that the scripts run; the timings mean nothing.
    """

    only: tuple[str, ...] = ()
    out: Path = Path("experiments/results/benchmarks")
    quick: bool = False


def main() -> int:
    """The command line."""
    benchmarks = tyro.cli(Benchmarks, prog="python -m experiments.benchmarks", description=__doc__)
    if unknown := [name for name in benchmarks.only if name not in RUNS]:
        raise UsageError(f"--only must be among {', '.join(RUNS)}; got {', '.join(unknown)}")
    commit = runtime.git_commit()
    for name in benchmarks.only or RUNS:
        out = benchmarks.out / f"{name}.json"
        if measured_at(out, benchmarks.quick) == commit and commit and not commit.endswith("-dirty"):
            print(f"== {name}: kept, measured at this commit", flush=True)
            continue
        print(f"== {name}", flush=True)
        script, *options = RUNS[name]
        command = [sys.executable, "-m", f"experiments.benchmarks.{script}", *options, "--out", str(out)]
        if code := subprocess.run([*command, "--quick"] if benchmarks.quick else command, check=False).returncode:
            return code
    return 0


def measured_at(out: Path, quick: bool) -> str | None:
    """The commit whose results are in a file, None if there are none of this size."""
    if not out.is_file():
        return None
    content = json.loads(out.read_text())
    commit: str | None = content["environment"]["git_commit"]
    return commit if content["settings"]["quick"] == quick else None


if __name__ == "__main__":
    exit_with(main)
