"""Training beside an eager PyTorch loop: `python -m experiments.benchmarks.training_throughput`.

The same algorithm, preset and target (Grid-World A) three times, on the CPU: ours; `_torch_apt_gen`, plain PyTorch around an
environment in Python; and that with its losses and optimiser steps compiled by `torch.compile`, for which a C++ compiler is
needed.  PyTorch is in the extra `peers`; without it ours are timed alone.  `tests/test_torch_fixture.py` shows that losses
and gradients are the same.

* One core: one seed, one process, one thread.
* Whole machine: ours trains the seeds in one program, spread over the cores.  PyTorch trains a seed on each core, in a process
  and a thread of its own, all at the same time; more seeds than cores would follow one after another at the same rate.

Ours ends each measurement with an evaluation of the target and of fresh tasks; PyTorch's loop has none.  What compiles is timed
apart, and the sides take turns, a measurement each.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Literal

import jax
import tyro

from apt_jax.lanes import make_program, stack_hparams, stack_targets
from apt_jax.trainer import Clock, make_trainer
from experiments import runtime
from experiments.benchmarks import _measure
from experiments.benchmarks._in_turns import Begun, Worker
from experiments.benchmarks._measure import Options, Problem, Timing
from experiments.errors import UsageError, exit_with

OURS = "ours"
PEERS = {"eager": "PyTorch, eager", "compile": "PyTorch, torch.compile"}


@dataclass(frozen=True)
class Args(Options):
    """Time training, ours and PyTorch's.

    Attributes:
      peers: what to time beside ours.
      preset: the sizes of all of them.
      seeds: that ours trains on the whole machine.
      cores: of the whole machine.
      steps: environment steps of each seed per measurement; a multiple of the preset's `refresh_every`.
    """

    peers: tuple[Literal["eager", "compile"], ...] = ("eager", "compile")
    preset: Literal["paper", "fast"] = "fast"
    seeds: int = 8
    cores: int = runtime.cores()
    steps: int = 1_000


@dataclass(frozen=True)
class Throughput:
    """Seconds per environment step of all seeds together.

    Attributes:
      one_core: of one seed on one core.
      machine: of as many as the machine trains at once.
    """

    one_core: Timing
    machine: Timing


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.training_throughput")
    _measure.check(args)
    if min(args.seeds, args.steps) < 1:
        raise UsageError(f"--seeds and --steps must be at least 1, got {args.seeds} and {args.steps}")
    jax.config.update("jax_platforms", "cpu")
    if args.quick:
        args = dataclasses.replace(args, repeats=2, steps=_measure.QUICK["eval_every"])
    if importlib.util.find_spec("torch") is None:
        print("left out: PyTorch (not installed)")
        args = dataclasses.replace(args, peers=())
    results = measure(args)
    _measure.report("training_throughput", args, {"sides": results}, table(results, args), peers=("torch",))
    return 0


def measure(args: Args) -> dict[str, Throughput]:
    """All sides, by their names in the table, ours first."""
    with ExitStack() as stack:

        def start(begin: Callable[..., Begun], seeds: int, *details: Any) -> tuple[Worker, int]:
            return stack.enter_context(Worker(begin, args, *details)), seeds * args.steps

        # By side, who trains alone and who train together.
        sides = {OURS: (start(begin_ours, 1, 1, 1), [start(begin_ours, args.seeds, args.seeds, args.cores)])}
        for peer in args.peers:
            workers = [start(begin_torch, 1, core, peer == "compile") for core in range(args.cores)]
            sides[PEERS[peer]] = workers[0], workers

        for alone, together in sides.values():
            train([alone])  # nothing is warm for the first
            train(together)
        seconds: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in sides}
        for _ in range(args.repeats):
            for name, (alone, _) in sides.items():
                seconds[name][0].append(train([alone]))
            for name, (_, together) in sides.items():
                seconds[name][1].append(train(together))
    return {
        name: Throughput(
            Timing(tuple(seconds[name][0]), alone[0].compile_seconds),
            Timing(tuple(seconds[name][1]), max(worker.compile_seconds for worker, _ in together)),
        )
        for name, (alone, together) in sides.items()
    }


def train(workers: Sequence[tuple[Worker, int]]) -> float:
    """Seconds per environment step of workers that train at the same time, each so many steps."""
    running = [(worker.start(), steps) for worker, steps in workers]
    return 1.0 / sum(steps / seconds.result() for seconds, steps in running)


def begin_ours(args: Args, seeds: int, cores: int) -> Begun:
    """Seeds of ours on some cores, warmed up."""
    _measure.pin(cores)
    # No compilation cache: the seconds to compile are results too.
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_num_cpu_devices", cores)
    space, target, config, hparams = load_problem(args)
    try:
        trainer = make_trainer(space, config)
    except ValueError as error:
        raise UsageError(str(error)) from error
    program = make_program(trainer, seeds)
    lanes = stack_hparams([hparams] * seeds)
    states = program.init(jax.random.split(jax.random.key(0), seeds), stack_targets([target] * seeds), lanes)
    states, clock = program.warmup(states, Clock.start(), lanes)
    chunk, compile_seconds = _measure.compile_ahead(program.chunk, states, clock, lanes)

    def train() -> None:
        nonlocal states, clock
        states, clock, _ = jax.block_until_ready(chunk(states, clock, lanes))

    return train, compile_seconds


def begin_torch(args: Args, core: int, compiled: bool) -> Begun:
    """One seed of PyTorch's on one core, warmed up; what compiles does so in the first iteration."""
    _measure.pin(1, first=core)
    os.environ["TORCHINDUCTOR_FORCE_DISABLE_CACHES"] = "1"  # the seconds to compile are results too
    jax.config.update("jax_platforms", "cpu")

    import torch

    from experiments.benchmarks._torch_apt_gen import Training

    torch.set_num_threads(1)
    _, target, config, hparams = load_problem(args)
    training = Training(config, hparams, target, seed=core, compiled=compiled)
    training.warm_up()
    began = time.perf_counter()
    training.train(training.steps_per_iteration)
    return lambda: training.train(args.steps), time.perf_counter() - began


def load_problem(args: Args) -> Problem:
    """The preset, evaluated after each measurement."""
    return _measure.load_problem(args.preset, **(_measure.QUICK if args.quick else {"eval_every": args.steps}))


def table(results: Mapping[str, Throughput], args: Args) -> str:
    """Steps per second, what ours are to the others', and the seconds to compile."""
    ours = results[OURS]
    rows = [
        [
            name,
            side.one_core.rate(),
            _measure.number(side.one_core.median / ours.one_core.median),
            side.machine.rate(),
            _measure.number(side.machine.median / ours.machine.median),
            f"{side.one_core.compile_seconds:.1f}",
        ]
        for name, side in results.items()
    ]
    return _measure.table(
        [
            f"{args.preset}: environment steps per second",
            "one seed, one core",
            "ours against",
            f"{args.seeds} seeds, {args.cores} cores",
            "ours against",
            "compile one seed, s",
        ],
        rows,
    )


if __name__ == "__main__":
    exit_with(main)
