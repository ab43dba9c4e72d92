"""Whether a step gets slower as the replay grows: `python -m experiments.benchmarks.capacity`.

Uniformly random tasks and one policy update per environment step, so that a copy of the rings would stand out.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import tyro

from apt_jax.trainer import Clock, make_trainer
from experiments import runtime
from experiments.benchmarks import _measure
from experiments.benchmarks._measure import Options, Timing
from experiments.errors import exit_with


@dataclass(frozen=True)
class Args(Options):
    """Time an environment step for several capacities of the replay.

    Attributes:
      capacities: environment steps of each source that the replay holds.
      cores: cores that the process may use.
      chunk_steps: environment steps per measurement.
    """

    capacities: tuple[int, ...] = (10_000, 20_000, 50_000, 100_000, 200_000)
    cores: int = 1
    chunk_steps: int = 500


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.capacity")
    _measure.check(args)
    _measure.pin(args.cores)
    runtime.setup(cpu_devices=1)
    if args.quick:
        args = dataclasses.replace(args, capacities=args.capacities[:1], chunk_steps=20, repeats=2)
    timings = {capacity: time_step(capacity, args) for capacity in args.capacities}
    base = timings[args.capacities[0]].median
    rows = [[f"{capacity:,}", timing.cell(), f"{timing.median / base:.3f}"] for capacity, timing in timings.items()]
    text = _measure.table(["replay capacity, steps per source", "ms per environment step", "ratio to the first"], rows)
    _measure.report("capacity", args, {"per_step": timings}, text)
    return 0


def time_step(capacity: int, args: Args) -> Timing:
    """An environment step with a replay of some capacity, all of it in use."""
    space, target, config, hparams = _measure.load_problem(
        "fast",
        method="random",
        updates_per_step=1,
        warmup_steps=1_000,
        recent_steps=1_000,
        replay_steps=capacity,
        refresh_every=args.chunk_steps,
        eval_every=args.chunk_steps,
        eval_episodes=1,
        probe_tasks=1,
    )
    trainer = make_trainer(space, config)
    state = jax.jit(trainer.init)(jax.random.key(0), target, hparams)
    # A clock past the ring's end makes samples come from all of the ring.
    columns = capacity // config.envs_per_source
    clock = Clock(iteration=jnp.int32(columns), env_steps=jnp.int32(2 * capacity))
    timing, _ = _measure.time_calls(trainer.chunk, (state, clock), hparams, repeats=args.repeats)
    return timing.per(args.chunk_steps)


if __name__ == "__main__":
    exit_with(main)
