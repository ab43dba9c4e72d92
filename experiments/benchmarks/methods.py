"""What each method costs beside plain DQN: `python -m experiments.benchmarks.methods`.

One seed on Grid-World A, in chunks of 5,000 steps, which hold refreshes and fits in their share; an evaluation, alike for all,
comes once in each where the presets have five.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import jax
import tyro

from apt_jax.methods import METHODS
from apt_jax.trainer import Clock, make_trainer
from experiments import runtime
from experiments.benchmarks import _measure
from experiments.benchmarks._measure import Options, Timing
from experiments.errors import UsageError, exit_with

BASE = "dqn"

QUICK: dict[str, Any] = {
    **_measure.QUICK,
    "model_updates_per_step": 0.1,
    "alp_window": 20,
    "alp_history": 20,
    "alp_fit_every": 20,
    "goal_tasks": 10,
}


@dataclass(frozen=True)
class Args(Options):
    """Time training by method.

    Attributes:
      methods: what to time; the ratios are to the first.
      preset: the sizes of all of them.
      cores: cores that the process may use.
      chunk_steps: environment steps per measurement; a multiple of ALP-GMM's 5,000 steps between fits counts those rightly.
    """

    methods: tuple[str, ...] = (BASE, *(method for method in METHODS if method != BASE))
    preset: Literal["paper", "fast"] = "fast"
    cores: int = 1
    chunk_steps: int = 5_000


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.methods")
    _measure.check(args)
    if not args.methods:
        raise UsageError("--methods needs at least one name")
    _measure.pin(args.cores)
    runtime.setup(cpu_devices=1)
    if args.quick:
        args = dataclasses.replace(args, repeats=1, chunk_steps=20)
    timings = {method: time_method(method, args) for method in args.methods}
    base = timings[args.methods[0]].median
    rows = [[method, timing.cell(1.0), f"{timing.median / base:.2f}"] for method, timing in timings.items()]
    text = _measure.table(["method", "seconds per 1,000 environment steps", f"ratio to {args.methods[0]}"], rows)
    _measure.report("methods", args, {"per_thousand_steps": timings}, text)
    return 0


def time_method(method: str, args: Args) -> Timing:
    """1,000 environment steps of a method."""
    sizes: dict[str, Any] = QUICK if args.quick else {"eval_every": args.chunk_steps}
    space, target, config, hparams = _measure.load_problem(args.preset, method=method, **sizes)
    try:
        trainer = make_trainer(space, config)
    except ValueError as error:
        raise UsageError(str(error)) from error
    state = jax.jit(trainer.init)(jax.random.key(0), target, hparams)
    carry = jax.jit(trainer.warmup, donate_argnums=0)(state, Clock.start(), hparams)
    timing, _ = _measure.time_calls(trainer.chunk, carry, hparams, repeats=args.repeats)
    return timing.per(args.chunk_steps / 1_000)


if __name__ == "__main__":
    exit_with(main)
