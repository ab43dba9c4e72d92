"""What the benchmarks share: pinning, timing, fresh processes, and the files and tables that results end up in."""

from __future__ import annotations

import dataclasses
import json
import math
import multiprocessing
import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

import envs
from apt_jax.config import PRESETS, Config, HParams
from experiments import markdown, runtime
from experiments.errors import UsageError

C = TypeVar("C")
F = TypeVar("F")
P = ParamSpec("P")
R = TypeVar("R")

PEERS = ("gymnasium", "minigrid", "xminigrid", "navix", "gymnax", "rejax", "stable-baselines3", "torch")
"""Packages that benchmarks compare with."""

QUICK: dict[str, Any] = {
    "warmup_steps": 500,
    "updates_per_step": 1,
    "batch_size": 8,
    "replay_steps": 1_000,
    "replay_episodes": 100,
    "model_batch_size": 8,
    "recent_steps": 500,
    "refresh_every": 10,
    "eval_every": 20,
    "eval_episodes": 2,
    "probe_tasks": 2,
}
"""Sizes that show within seconds that a script works; its figures mean nothing."""


@dataclass(frozen=True)
class Options:
    """What every benchmark can be told.

    Attributes:
      out: the JSON file to write, by default runs/benchmarks/NAME.json.
      repeats: how often each measurement is taken; medians and ranges are over these.
      quick: everything tiny, to see that the script runs; its timings mean nothing.
    """

    out: Path | None = None
    repeats: int = 5
    quick: bool = False


@dataclass(frozen=True)
class Timing:
    """Seconds of one run of something, an entry per repeat, and the seconds it took to compile."""

    seconds: tuple[float, ...]
    compile_seconds: float

    @property
    def median(self) -> float:
        """Median over the repeats."""
        return statistics.median(self.seconds)

    def per(self, count: float) -> Timing:
        """The same per one of `count` things done in a run."""
        return dataclasses.replace(self, seconds=tuple(s / count for s in self.seconds))

    def cell(self, unit: float = 1e-3) -> str:
        """Median and range in multiples of `unit` seconds, for a table."""
        median, low, high = (number(s / unit) for s in (self.median, min(self.seconds), max(self.seconds)))
        return f"{median} ({low} to {high})"

    def rate(self, count: float = 1.0) -> str:
        """Median and range of how many things a second are done, `count` of them in a run, for a table."""
        median, low, high = (number(count / s) for s in (self.median, max(self.seconds), min(self.seconds)))
        return f"{median} ({low} to {high})"


class Problem(NamedTuple):
    """The task that everything is measured on, and a preset for it."""

    space: envs.BenchmarkSpace
    target: Any
    config: Config
    hparams: HParams


def load_problem(preset: str, *, space: str = "grid_world", **changes: Any) -> Problem:
    """A preset with some fields of its config changed, and target A of a space."""
    config, hparams = PRESETS[preset]
    return Problem(envs.make(space), envs.load_target(space, "A"), dataclasses.replace(config, **changes), hparams)


def check(options: Options) -> None:
    """To be called first: takes down the conditions; raises a `UsageError` for options that cannot be."""
    _at_start()
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        numbers = value if isinstance(value, tuple) else (value,)
        if not numbers or any(isinstance(number, int) and not isinstance(number, bool) and number < 1 for number in numbers):
            raise UsageError(
                f"--{field.name.replace('_', '-')} must be at least 1, got {' '.join(map(str, numbers)) or 'none'}"
            )


def pin(cores: int, *, first: int = 0) -> None:
    """Keeps this process and the threads it will start on `cores` cores; call before JAX starts its backend.

    Args:
      first: cores that are left to others before these.

    Raises:
      UsageError: there are fewer, or the system cannot pin.
    """
    if not hasattr(os, "sched_setaffinity"):
        raise UsageError("pinning to cores needs Linux")
    allowed = sorted(os.sched_getaffinity(0))
    if not 1 <= cores <= len(allowed) - first:
        raise UsageError(f"--cores must be between 1 and the {len(allowed)} this process may use, got {cores}")
    os.sched_setaffinity(0, allowed[first : first + cores])


def time_loop(step: Callable[[C, F], C], carry: C, fixed: F, *, repeats: int, at_least: float) -> Timing:
    """Times `carry = step(carry, fixed)` in a compiled loop of as many runs as take `at_least` seconds.

    `carry` is copied, because the loop donates it.  `fixed` is an argument of the program, never a constant that the compiler
    could compute with.
    """

    def loop(carry: C, fixed: F, length: Any) -> C:
        return jax.lax.fori_loop(0, length, lambda _, c: step(c, fixed), carry)

    carry = jax.tree.map(jnp.copy, carry)
    compiled, compile_seconds = compile_ahead(jax.jit(loop, donate_argnums=0), carry, fixed, np.int32(1))

    def run(length: int) -> float:
        nonlocal carry
        began = time.perf_counter()
        carry = jax.block_until_ready(compiled(carry, fixed, np.int32(length)))
        return time.perf_counter() - began

    run(1)
    length = 1
    while (seconds := run(length)) < at_least:
        length = int(length * min(max(1.2 * at_least / seconds, 1.5), 16.0)) + 1
    return Timing(tuple(run(length) / length for _ in range(repeats)), compile_seconds)


def time_calls(
    function: Callable[..., tuple[Any, ...]], carry: tuple[Any, ...], fixed: Any, *, repeats: int
) -> tuple[Timing, tuple[Any, ...]]:
    """Times `(*carry, output) = function(*carry, fixed)`, jitted with its first argument donated (after a copy).

    Returns:
      The times without the first call, which nothing is warm for, and the carry after all calls.
    """
    carry = jax.tree.map(jnp.copy, carry)
    compiled, compile_seconds = compile_ahead(jax.jit(function, donate_argnums=0), *carry, fixed)
    seconds, carry = time_runs(compiled, carry, fixed, repeats=repeats)
    return Timing(seconds, compile_seconds), carry


def time_runs(
    compiled: Callable[..., tuple[Any, ...]], carry: tuple[Any, ...], fixed: Any, *, repeats: int
) -> tuple[tuple[float, ...], tuple[Any, ...]]:
    """The seconds of each run of `(*carry, output) = compiled(*carry, fixed)` but the first, and the carry after all runs."""

    def run() -> float:
        nonlocal carry
        began = time.perf_counter()
        *after, output = compiled(*carry, fixed)
        jax.block_until_ready((after, output))
        carry = tuple(after)
        return time.perf_counter() - began

    run()
    return tuple(run() for _ in range(repeats)), carry


def compile_ahead(function: Callable[..., Any], *args: Any) -> tuple[Any, float]:
    """A jitted function compiled for some arguments, and the seconds that took."""
    began = time.perf_counter()
    compiled = cast(jax.stages.Wrapped, function).lower(*args).compile()
    return compiled, time.perf_counter() - began


def in_new_process(function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Calls a module's function in a Python process of its own, because JAX is set up once per process."""
    with ProcessPoolExecutor(max_workers=1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *args, **kwargs).result()


def peak_memory() -> int:
    """Largest resident size of this process so far, in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def number(value: float) -> str:
    """Three significant digits, never in exponential form."""
    return f"{float(f'{value:.3g}'):,.12g}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; every column but the first is aligned to the right."""
    return markdown.table(header, rows, numbers=True) + "\n"


def result_path(name: str, options: Options) -> Path:
    """The file that a benchmark's raw numbers go to."""
    return options.out or Path("runs") / "benchmarks" / f"{name}.json"


def report(name: str, options: Options, results: Mapping[str, Any], text: str, *, peers: Sequence[str] = ()) -> None:
    """Prints the tables and writes them with the raw numbers and all that is needed to read these.

    Args:
      peers: packages of `PEERS` that ours is compared with.
    """
    environment = {**runtime.describe(), **_at_start()}
    settings = {key: value for key, value in dataclasses.asdict(options).items() if key != "out"}
    text = f"{text.strip()}\n\n{_caption(environment, options, peers)}"
    content = {
        "benchmark": name,
        "settings": settings,
        "environment": environment,
        "results": results,
        "text": text.splitlines(),
    }
    path = result_path(name, options)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, default=dataclasses.asdict) + "\n")
    print(f"{text}\n\nRaw numbers: {path}")


def _caption(environment: Mapping[str, Any], options: Options, peers: Sequence[str]) -> str:
    """What a reader of the tables has to know: repeats, machine, versions, commit, and what else was running."""
    packages = {**environment["packages"], **environment["peers"]}
    named = ("jax", "jaxlib", "flax", "optax", "numpy", *peers)
    versions = ", ".join(f"{name} {packages[name]}" for name in named if packages[name])
    commit, dash, dirty = (environment["git_commit"] or "unknown").partition("-")
    repeats = "Measured once" if options.repeats == 1 else f"Median (range) of {options.repeats} repeats"
    return (
        f"{repeats}; {environment['cpu']}, {environment['cores']} cores, "
        f"{environment['device_kind']}; {versions}; commit {commit[:12]}{dash}{dirty}; "
        f"{environment['busy']:.0%} of the machine busy before it began."
    )


@cache
def _at_start() -> dict[str, Any]:
    """Conditions as at the first call: later commits are not what is measured, and later work is the benchmark's own."""
    return {**conditions(), "busy": busy_share()}


def conditions() -> dict[str, Any]:
    """What two measurements have to have in common to be compared: code, machine, packages."""
    return {
        "git_commit": runtime.git_commit(),
        "cpu": _cpu_model(),
        "cores": runtime.cores(),
        "packages": runtime.versions(),
        "peers": runtime.versions(PEERS),
    }


def busy_share(seconds: float = 1.0) -> float:
    """Share of all cores' time that others use while this process sleeps; NaN where the system does not tell."""

    def times() -> tuple[int, int]:
        user, nice, system, idle, wait, *rest = map(int, Path("/proc/stat").read_text().split("\n")[0].split()[1:])
        return idle + wait, user + nice + system + idle + wait + sum(rest[:3])

    if not Path("/proc/stat").is_file():
        return math.nan
    idle, total = times()
    time.sleep(seconds)
    idle_after, total_after = times()
    return 1.0 - (idle_after - idle) / max(total_after - total, 1)


def _cpu_model() -> str:
    """The processor's name as the system gives it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
