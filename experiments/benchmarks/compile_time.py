"""How long a run takes to get going: `python -m experiments.benchmarks.compile_time`.

Each start is a new process, with a compilation cache that is empty ("cold") or that the start before has filled ("warm").
What happens before anything is compiled, importing and answering `--help`, is timed apart.
"""

from __future__ import annotations

import dataclasses
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import tyro

from apt_jax.lanes import make_program, stack_hparams, stack_targets
from apt_jax.trainer import Clock, make_trainer
from experiments import runtime
from experiments.benchmarks import _measure
from experiments.benchmarks._measure import Options, Timing
from experiments.errors import exit_with
from experiments.programs import Programs


@dataclass(frozen=True)
class Args(Options):
    """Time the start of a training run.

    Attributes:
      space: where to train, on its target A.
      preset: what is trained.
      seeds: seeds in the program, one after another on each device.
      cores: cores that the process may use.
    """

    space: Literal["grid_world", "manipulation"] = "grid_world"
    preset: Literal["paper", "fast"] = "fast"
    seeds: int = 1
    cores: int = 2


@dataclass(frozen=True)
class Start:
    """Seconds, each counted on its own but for the last.

    Attributes:
      imports: from the request for a process to the benchmark's first line in it.
      init: to trace, lower and compile `Program.init`, or to load what was kept of it.
      training: the same for `Program.warmup` and `Program.chunk`, side by side.
      first_chunk: from the request for a process to the end of the first chunk, the steps before any update included.
      peak_memory: largest resident size of the process, in bytes.
    """

    imports: float
    init: float
    training: float
    first_chunk: float
    peak_memory: int


IMPORTS = {
    "import apt_jax": ("-c", "import apt_jax"),
    "experiments.train --help": ("-m", "experiments.train", "--help"),
}
"""Arguments of a Python that compiles nothing."""


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.compile_time")
    _measure.check(args)
    if args.quick:
        args = dataclasses.replace(args, repeats=1)
    starts: dict[str, list[Start]] = {"cold": [], "warm": []}
    for _ in range(args.repeats):
        with tempfile.TemporaryDirectory() as cache:
            for kind in starts:
                latest = _measure.in_new_process(start, Path(cache), args, requested=time.time())
                print(f"{kind}: first chunk done after {latest.first_chunk:.1f} s", flush=True)
                starts[kind].append(latest)
    imports = {name: time_process(*arguments, repeats=args.repeats) for name, arguments in IMPORTS.items()}
    columns: dict[str, Callable[[Start], float]] = {
        "process and imports, s": lambda s: s.imports,
        "init, s": lambda s: s.init,
        "warmup and chunk, s": lambda s: s.training,
        "first chunk done after, s": lambda s: s.first_chunk,
        "peak memory, MiB": lambda s: s.peak_memory / 2**20,
    }
    rows = [[kind, *(_cell([column(s) for s in group]) for column in columns.values())] for kind, group in starts.items()]
    text = "\n".join(
        (
            _measure.table(["process", "s"], [[name, timing.cell(1.0)] for name, timing in imports.items()]),
            _measure.table(["cache", *columns], rows),
        )
    )
    name = "compile_time" if args.space == "grid_world" else f"compile_time_{args.space}"
    _measure.report(name, args, {**starts, "imports": imports}, text)
    return 0


def time_process(*arguments: str, repeats: int) -> Timing:
    """A Python process from start to end; the first, which writes byte code and fills the disk's cache, is left out."""

    def run() -> float:
        began = time.perf_counter()
        subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - began

    run()
    return Timing(tuple(run() for _ in range(repeats)), 0.0)


def start(cache: Path, args: Args, *, requested: float) -> Start:
    """Begins a run in this process; `requested` is the time at which it was asked for."""
    imports = time.time() - requested
    _measure.pin(args.cores)
    runtime.setup()
    jax.config.update("jax_compilation_cache_dir", str(cache))
    space, target, config, one = _measure.load_problem(args.preset, space=args.space, **(_measure.QUICK if args.quick else {}))
    program = make_program(make_trainer(space, config), args.seeds)
    targets, hparams = stack_targets([target] * args.seeds), stack_hparams([one] * args.seeds)
    programs = Programs.of(args)

    lanes = jax.random.split(jax.random.key(0), args.seeds), targets, hparams
    began = time.perf_counter()
    init = programs.compile("init", program.init, *lanes)
    init_seconds = time.perf_counter() - began
    training = init(*lanes), Clock.start(), hparams
    began = time.perf_counter()
    compiled = programs.compile_all({"warmup": program.warmup, "chunk": program.chunk}, *training)
    training_seconds = time.perf_counter() - began
    states, clock = compiled["warmup"](*training)
    jax.block_until_ready(compiled["chunk"](states, clock, hparams))
    return Start(
        imports=imports,
        init=init_seconds,
        training=training_seconds,
        first_chunk=time.time() - requested,
        peak_memory=_measure.peak_memory(),
    )


def _cell(values: list[float]) -> str:
    median, low, high = (_measure.number(value) for value in (statistics.median(values), min(values), max(values)))
    return f"{median} ({low} to {high})"


if __name__ == "__main__":
    exit_with(main)
