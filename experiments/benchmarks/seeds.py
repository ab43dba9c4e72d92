"""What a seed costs among others, by how seeds are laid out: `python -m experiments.benchmarks.seeds`.

Every arrangement has the same cores.  Each runs in a process of its own, because the number of devices is fixed per process.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Literal

import jax
import numpy as np
import tyro
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from apt_jax.lanes import make_program, stack_hparams
from apt_jax.trainer import Clock, make_trainer
from experiments import runtime
from experiments.benchmarks import _measure
from experiments.benchmarks._measure import Options, Timing
from experiments.errors import UsageError, exit_with


@dataclass(frozen=True)
class Args(Options):
    """Time training with several seeds side by side.

    Attributes:
      seeds: numbers of seeds.
      layouts: how the seeds of one device are laid out.
      devices: numbers of devices that the seeds are spread over.
      cores: cores that every arrangement may use.
      preset: what is trained.
      chunk_steps: environment steps of each seed per measurement.
    """

    repeats: int = 3
    seeds: tuple[int, ...] = (1, 2, 4, 8, 16)
    layouts: tuple[Literal["map", "vmap"], ...] = ("map", "vmap")
    devices: tuple[int, ...] = (1, 2)
    cores: int = 2
    preset: Literal["paper", "fast"] = "fast"
    chunk_steps: int = 100


@dataclass(frozen=True)
class Arrangement:
    """One layout on some devices, and the time per seed by number of seeds, in seconds for 1,000 environment steps."""

    layout: Literal["map", "vmap"]
    devices: int
    per_seed: dict[int, Timing]


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.seeds")
    _measure.check(args)
    if args.quick:
        args = dataclasses.replace(
            args, seeds=args.seeds[:2], layouts=args.layouts[:1], devices=args.devices[-1:], chunk_steps=10
        )
    pairs = itertools.product(args.devices, args.layouts)
    results = [_measure.in_new_process(time_seeds, layout, devices, args) for devices, layout in pairs]
    rows = [
        [f"{result.layout}, {result.devices} device{'s'[: result.devices - 1]}"]
        + [result.per_seed[seeds].cell(1.0) if seeds in result.per_seed else "" for seeds in args.seeds]
        for result in results
    ]
    header = ["layout", *(f"{seeds} seed{'s'[: seeds - 1]}" for seeds in args.seeds)]
    text = f"Seconds per seed and 1,000 environment steps, {args.cores} cores:\n\n{_measure.table(header, rows)}"
    _measure.report("seeds", args, {"arrangements": results}, text)
    return 0


def time_seeds(layout: Literal["map", "vmap"], devices: int, args: Args) -> Arrangement:
    """Every number of seeds that fills `devices`, in this process."""
    _measure.pin(args.cores)
    runtime.setup(cpu_devices=devices)
    if jax.device_count() < devices:
        raise UsageError(f"--devices must be at most {jax.device_count()} here, got {devices}")
    return Arrangement(layout, devices, {n: _time(n, layout, devices, args) for n in args.seeds if n >= devices})


def _time(seeds: int, layout: Literal["map", "vmap"], devices: int, args: Args) -> Timing:
    problem = _measure.load_problem(
        args.preset,
        warmup_steps=1_000,
        refresh_every=args.chunk_steps,
        eval_every=args.chunk_steps,
        eval_episodes=1,
        probe_tasks=1,
    )
    trainer = make_trainer(problem.space, problem.target, problem.config)
    used = jax.devices()[:devices]
    program = make_program(trainer, seeds, layout=layout, devices=used)
    hparams = stack_hparams([problem.hparams] * seeds)
    states = program.init(jax.random.split(jax.random.key(0), seeds), hparams)
    clock = jax.device_put(Clock.start(), NamedSharding(Mesh(np.array(used), ("lane",)), PartitionSpec()))
    states, clock = program.warmup(states, clock, hparams)
    timing, _ = _measure.time_calls(program.chunk, (states, clock), hparams, repeats=args.repeats)
    return timing.per(seeds * args.chunk_steps / 1_000)


if __name__ == "__main__":
    exit_with(main)
