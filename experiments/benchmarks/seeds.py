"""What a seed costs among others, by how seeds are laid out: `python -m experiments.benchmarks.seeds`.

Every arrangement has the same cores.  Each runs in a process of its own, because the number of devices is fixed per process.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from apt_jax.lanes import make_program, stack_hparams
from apt_jax.trainer import Clock, TrainState, make_trainer
from experiments import runtime
from experiments.benchmarks import _measure
from experiments.benchmarks._measure import Options, Timing
from experiments.errors import UsageError, exit_with


@dataclass(frozen=True)
class Args(Options):
    """Time training with several seeds side by side.

    Attributes:
      space: where to train, on its target A.
      seeds: numbers of seeds.
      layouts: how the seeds of one device are laid out.
      devices: numbers of devices that the seeds are spread over.
      cores: cores that every arrangement may use.
      preset: what is trained.
      chunk_steps: environment steps of each seed per measurement.
    """

    space: Literal["grid_world", "manipulation"] = "grid_world"
    seeds: tuple[int, ...] = (1, 2, 4, 8, 16)
    layouts: tuple[Literal["map", "vmap"], ...] = ("map", "vmap")
    devices: tuple[int, ...] = (1, 2)
    cores: int = 2
    preset: Literal["paper", "fast"] = "fast"
    chunk_steps: int = 1_000


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
    cores = f"{args.cores} core{'s'[: args.cores - 1]}"
    text = f"Seconds per seed and 1,000 environment steps, on {cores}:\n\n{_measure.table(header, rows)}"
    name = "seeds" if args.space == "grid_world" else f"seeds_{args.space}"
    _measure.report(name, args, {"arrangements": results}, text)
    return 0


def time_seeds(layout: Literal["map", "vmap"], devices: int, args: Args) -> Arrangement:
    """Every number of seeds that `devices` divide equally, in this process."""
    _measure.pin(args.cores)
    runtime.setup(cpu_devices=devices)
    if jax.device_count() < devices:
        raise UsageError(f"--devices must be at most {jax.device_count()} here, got {devices}")
    space, target, config, hparams = _measure.load_problem(
        args.preset,
        space=args.space,
        warmup_steps=1_000,
        refresh_every=args.chunk_steps,
        eval_every=args.chunk_steps,
        eval_episodes=1,
        probe_tasks=1,
    )
    trainer = make_trainer(space, config)
    # One warm-up serves all: compiling it for every number of seeds would take longer than everything measured.
    state = jax.jit(trainer.init)(jax.random.key(0), target, hparams)
    state, clock = jax.jit(trainer.warmup, donate_argnums=0)(state, Clock.start(), hparams)
    mesh = Mesh(np.array(jax.devices()[:devices]), ("lane",))
    shared, lane = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec("lane"))

    def time_lanes(lanes: int) -> Timing:
        @partial(jax.jit, out_shardings=lane)
        def tile(state: TrainState) -> TrainState:
            states = jax.tree.map(lambda x: jnp.stack([x] * lanes), state)
            return states._replace(key=jax.random.split(state.key, lanes))

        program = make_program(trainer, lanes, layout=layout, devices=jax.devices()[:devices])
        carry = tile(state), jax.device_put(clock, shared)
        timing, _ = _measure.time_calls(program.chunk, carry, stack_hparams([hparams] * lanes), repeats=args.repeats)
        return timing.per(lanes * args.chunk_steps / 1_000)

    return Arrangement(layout, devices, {lanes: time_lanes(lanes) for lanes in args.seeds if lanes % devices == 0})


if __name__ == "__main__":
    exit_with(main)
