"""Train several methods on several targets, then compare them: `python -m experiments.compare --out DIR --methods dqn rnd`.

Every other option is one of `experiments.train` and holds for all runs.  Each method and target is a run directory of its own,
OUT/TARGET/METHOD.  Stop at any moment and repeat the command: what is finished is kept, what was stopped goes on.

Runs are made one after another, or with --ray as jobs of a cluster, all of whose machines have to see OUT.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import tyro

from apt_jax.methods import METHODS
from experiments import command_line, jobs, plots, processes, report
from experiments.errors import UsageError, exit_with
from experiments.interrupt import EXIT_CODE
from experiments.problem import make_problem
from experiments.settings import Experiment, Session
from experiments.train import start_jax, train

OWN = ("run-dir", "resume", "method", "target", "config.method")
"""Options of `experiments.train` that are decided here."""


@dataclass(frozen=True)
class Compare:
    """Compare methods on targets.

    All other options, such as --seeds, --env-steps, --preset and --devices, are those of `python -m experiments.train --help`.

    Attributes:
      out: where the runs, `comparison.md` and `comparison.png` go.
      methods: what to compare, by default all ten methods; with a bonus added as in "apt_gen+rnd".
      targets: names of targets, or files that describe them.
      seeds_per_job: split the seeds of a method and target into runs of so many, OUT/TARGET/METHOD/seeds_...; by default they
        are lanes of one.
      ray: make the runs as jobs on Ray, as many at a time as there is room for (extra `ray`); each takes --devices CPUs, one by
        default, and goes on from its checkpoint when its process or machine is lost.
      gpus_per_job: GPUs that each such job takes.
    """

    out: Path
    methods: tuple[str, ...] = tuple(METHODS)
    targets: tuple[str, ...] = ("A",)
    seeds_per_job: int | None = None
    ray: bool = False
    gpus_per_job: float = 0.0


def main() -> int:
    """The command line."""
    comparison, options = tyro.cli(
        Compare, prog="python -m experiments.compare", return_unknown_args=True, config=(tyro.conf.FlagCreatePairsOff,)
    )
    runs = plan(comparison, options)
    if comparison.ray:
        jax.config.update("jax_platforms", "cpu")  # accelerators are for the jobs
    else:
        start_jax(runs[0][1])
    for experiment, _ in runs:  # what is wrong with the last is told before the first begins
        make_problem(experiment)
    code = make_on_ray(comparison, runs) if comparison.ray else make_in_turn(runs)
    if code:
        print("to go on with the comparison: repeat the command")
        return code
    if processes.is_first():
        print(summarise(comparison))
    return 0


def make_in_turn(runs: Sequence[tuple[Experiment, Session]]) -> int:
    """One run after another, here; returns the exit code of the first that was stopped."""
    return next((code for run in runs if (code := train(*run))), 0)


def make_on_ray(comparison: Compare, runs: Sequence[tuple[Experiment, Session]]) -> int:
    """All runs as jobs; returns 0 if all were finished, says which were not."""
    cpus = runs[0][1].devices or 1
    pending = [
        (
            dataclasses.replace(experiment, target_file=experiment.target_file and experiment.target_file.resolve()),
            dataclasses.replace(session, devices=cpus, run_dir=session.run_dir.resolve()),
        )
        for experiment, session in runs
    ]
    try:
        results = jobs.on_ray(make_alone, pending, cpus=cpus, gpus=comparison.gpus_per_job)
    except KeyboardInterrupt:
        return EXIT_CODE
    for (_, session), result in zip(runs, results, strict=True):
        if result:
            print(f"{session.run_dir} is not finished: {result}")
    return int(any(results))


def make_alone(experiment: Experiment, session: Session) -> int:
    """A run in a process that does nothing else; goes on with what an earlier process has left."""
    start_jax(session)
    return train(experiment, dataclasses.replace(session, resume=(session.run_dir / "config.json").is_file()))


def plan(comparison: Compare, options: Sequence[str]) -> list[tuple[Experiment, Session]]:
    """Every run to be made or gone on with, target by target.

    Raises:
      UsageError: an option that is decided here, something missing or at odds, or what `experiments.train` refuses.
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
    if comparison.seeds_per_job is not None and comparison.seeds_per_job < 1:
        raise UsageError(f"--seeds-per-job must be at least 1, got {comparison.seeds_per_job}")
    runs = []
    for target in comparison.targets:
        for method in comparison.methods:
            words = ["--target", target, "--method", method, *options]
            path = run_path(comparison, method, target)
            parts = {part.name for part in path.glob("seeds_*")}
            if comparison.seeds_per_job is None:
                if parts:
                    raise UsageError(
                        f"{path} holds runs of some seeds each; say --seeds-per-job as then, or take another --out"
                    )
                runs.append(_run(path, words))
                continue
            if (path / "config.json").is_file():
                raise UsageError(f"{path} holds a run of all its seeds; leave --seeds-per-job away, or take another --out")
            seeds = command_line.parse(["--run-dir", str(path), *words])[0].seeds
            groups = [seeds[i : i + comparison.seeds_per_job] for i in range(0, len(seeds), comparison.seeds_per_job)]
            planned = {f"seeds_{'_'.join(map(str, own))}": own for own in groups}
            if others := parts - set(planned):
                raise UsageError(
                    f"{path} holds {', '.join(sorted(others))}, of other --seeds or --seeds-per-job; "
                    "repeat those, or take another --out"
                )
            runs += [_run(path / name, [*words, "--seeds", *map(str, own)]) for name, own in planned.items()]
    if comparison.ray:
        if runs[0][1].distributed:
            raise UsageError("--ray and --distributed exclude each other: a job is one process")
        jobs.check_installed()
    return runs


def _run(path: Path, words: Sequence[str]) -> tuple[Experiment, Session]:
    begun = (path / "config.json").is_file()
    try:
        return command_line.parse(["--run-dir", str(path), *["--resume"] * begun, *words])
    except UsageError as error:
        raise UsageError(f"{path}, begun earlier: {error}" if begun else str(error)) from error


def run_path(comparison: Compare, method: str, target: str) -> Path:
    """Where a run lives, or its parts."""
    return comparison.out / Path(target).stem / method


def run_parts(comparison: Compare, method: str, target: str) -> list[Path]:
    """The run directories of a method and target."""
    path = run_path(comparison, method, target)
    return [path] if (path / "config.json").is_file() else sorted(path.glob("seeds_*"))


def summarise(comparison: Compare) -> str:
    """Writes comparison.md and comparison.png, for finished runs; returns the text."""
    panels = {
        Path(target).stem: {
            name: run
            for method in comparison.methods
            for name, run in report.read_parts(method, run_parts(comparison, method, target)).items()
        }
        for target in comparison.targets
    }
    text = "\n\n".join(f"Target {target}:\n\n{report.table(runs)}" for target, runs in panels.items())
    (comparison.out / "comparison.md").write_text(text + "\n")
    plots.comparison(comparison.out / "comparison.png", panels)
    return text


if __name__ == "__main__":
    exit_with(main)
