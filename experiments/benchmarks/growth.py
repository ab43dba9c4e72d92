"""How time and memory grow with what a run is made of: `python -m experiments.benchmarks.growth`.

APT-Gen on Grid-World A with preset `fast`, of which one number is changed at a time: seeds, environments per source, the
replay's capacity, the horizon of an episode, the length of a task parameter.  A wrapper of the task space (`_stretched`) cuts
episodes off elsewhere than after 50 steps, and adds numbers without meaning to the parameter.

Time is that of an iteration: every environment of every seed makes a step, and the updates that belong to these steps.  An
evaluation after ten of them counts in its share.  Memory is what the compiled program needs: its state, most of it the replay,
and what it computes with besides.  Nothing should grow faster than the number itself, the dashed line.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro
from matplotlib.figure import Figure

from apt_jax.lanes import make_program, stack_hparams, stack_targets
from apt_jax.specs import param_struct
from apt_jax.trainer import Clock, make_trainer
from envs.grid_world.dynamics import HORIZON
from envs.grid_world.placement import PARAM_SPEC
from experiments import runtime
from experiments.benchmarks import _measure
from experiments.benchmarks._measure import Options, Problem, Timing
from experiments.benchmarks._parts import SOURCES
from experiments.benchmarks._stretched import Stretched
from experiments.errors import exit_with

ITERATIONS = 10
"""Per measurement."""

PARAMETER = sum(block.size for block in param_struct(PARAM_SPEC).values())
"""Numbers in Grid-World's task parameter."""

Axis = Literal["seeds", "environments", "capacity", "horizon", "parameter"]


@dataclass(frozen=True)
class Point:
    """What a run is made of.

    Attributes:
      seeds: one after another on a core.
      environments: of each source, per seed.
      capacity: steps of each source that the replay holds.
      horizon: of an episode.
      parameter: numbers in a task parameter.
    """

    seeds: int = 1
    environments: int = 5
    capacity: int = 102_400
    horizon: int = HORIZON
    parameter: int = PARAMETER


AXES: Mapping[Axis, tuple[int, ...]] = {
    "seeds": (1, 2, 4, 8, 16, 32, 64),
    "environments": (5, 10, 20, 40),
    "capacity": (25_600, 51_200, 102_400, 204_800, 409_600),
    "horizon": (25, 50, 100, 200, 400),
    "parameter": (PARAMETER, 2 * PARAMETER, 4 * PARAMETER, 8 * PARAMETER),
}


@dataclass(frozen=True)
class Args(Options):
    """Measure an iteration of training as one number after the other grows.

    Attributes:
      axes: the numbers.
      cores: cores that the process may use.
    """

    axes: tuple[Axis, ...] = tuple(AXES)
    cores: int = 1


@dataclass(frozen=True)
class Cost:
    """Of an iteration, and in bytes: of the state, and of what the program needs besides."""

    iteration: Timing
    state: int
    besides: int


Growth = Mapping[Axis, Mapping[int, Cost]]
"""What each value of each number costs."""


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.growth")
    _measure.check(args)
    _measure.pin(args.cores)
    runtime.setup(cpu_devices=1)
    values = AXES
    if args.quick:
        args = dataclasses.replace(args, repeats=2)
        values = {axis: sizes[:2] for axis, sizes in AXES.items()}
    growth = {axis: {size: measure(at(axis, size), args) for size in values[axis]} for axis in args.axes}
    picture = _measure.result_path("growth", args).with_suffix(".png")
    picture.parent.mkdir(parents=True, exist_ok=True)
    draw(picture, growth)
    _measure.report("growth", args, {"growth": growth}, f"{tables(growth)}\nPicture: {picture}\n")
    return 0


def at(axis: Axis, size: int) -> Point:
    """The run of which one number is `size`."""
    return dataclasses.replace(Point(), **{axis: size})


def load_problem(point: Point, quick: bool) -> Problem:
    """Grid-World A and preset `fast` with the numbers of `point`."""
    steps = ITERATIONS * SOURCES * point.environments
    changes: dict[str, Any] = {
        "envs_per_source": point.environments,
        "replay_steps": point.capacity,
        "refresh_every": steps,
        "eval_every": steps,
        "eval_episodes": max(steps // 20, 1),
        "probe_tasks": max(steps // 16, 1),
    }
    small = {name: _measure.QUICK[name] for name in ("updates_per_step", "batch_size", "model_batch_size")} if quick else {}
    problem = _measure.load_problem("fast", **changes, **small)
    space: Any = Stretched(problem.space, horizon=point.horizon, more=point.parameter - PARAMETER)
    return problem._replace(space=space)


@cache
def measure(point: Point, args: Args) -> Cost:
    """What an iteration costs; where all numbers are the usual ones, axes meet."""
    space, target, config, hparams = load_problem(point, args.quick)
    trainer = make_trainer(space, config)
    program, lanes = make_program(trainer, point.seeds), stack_hparams([hparams] * point.seeds)
    states = program.init(jax.random.split(jax.random.key(0), point.seeds), stack_targets([target] * point.seeds), lanes)
    # A clock past the ring's end makes samples come from all of the ring.
    columns = config.replay_steps // config.envs_per_source
    clock = Clock(iteration=jnp.int32(columns), env_steps=jnp.int32(SOURCES * config.replay_steps))
    chunk, compile_seconds = _measure.compile_ahead(program.chunk, states, clock, lanes)
    memory = chunk.memory_analysis()
    seconds, _ = _measure.time_runs(chunk, (states, clock), lanes, repeats=args.repeats)
    return Cost(
        iteration=Timing(seconds, compile_seconds).per(ITERATIONS),
        state=memory.argument_size_in_bytes,
        besides=memory.temp_size_in_bytes,
    )


def tables(growth: Growth) -> str:
    """One for each number."""
    return "\n".join(table(axis, costs) for axis, costs in growth.items())


def table(axis: Axis, costs: Mapping[int, Cost]) -> str:
    """Times and sizes, and how often the first one's they are."""
    (least, first), *_ = costs.items()

    def row(size: int, cost: Cost) -> list[str]:
        point = at(axis, size)
        steps = point.seeds * SOURCES * point.environments
        return [
            f"{size:,} ({_measure.number(size / least)})",
            cost.iteration.cell(),
            _measure.number(1e3 * cost.iteration.median / steps),
            _measure.number(cost.iteration.median / first.iteration.median),
            _measure.number(cost.state / 2**20),
            _measure.number(cost.besides / 2**20),
            _measure.number((cost.state + cost.besides) / (first.state + first.besides)),
            _measure.number(cost.state / point.seeds / 2**20),
        ]

    header = [
        axis,
        "ms per iteration",
        "ms per environment step",
        "iteration, times the first",
        "state, MiB",
        "besides, MiB",
        "both, times the first",
        "state per seed, MiB",
    ]
    return _measure.table(header, [row(size, cost) for size, cost in costs.items()])


def draw(file: Path, growth: Growth) -> None:
    """Time above memory, a column for each number, all axes logarithmic; dashed: growth in proportion."""
    figure = Figure(figsize=(3.0 * len(growth), 5.2), layout="constrained")
    panels = figure.subplots(2, len(growth), squeeze=False)
    for column, (axis, costs) in enumerate(growth.items()):
        sizes = list(costs)
        curves = {
            "ms per iteration": [1e3 * cost.iteration.median for cost in costs.values()],
            "MiB": [(cost.state + cost.besides) / 2**20 for cost in costs.values()],
        }
        for axes, (label, values) in zip(panels[:, column], curves.items(), strict=True):
            axes.plot(sizes, [values[0] * size / sizes[0] for size in sizes], "--", color="gray", linewidth=1)
            axes.plot(sizes, values, marker=".")
            axes.set_xscale("log", base=2)
            axes.set_yscale("log", base=2)
            axes.set_xlabel(axis)
            axes.set_ylabel(label)
            axes.set_xticks(sizes, [f"{size:,}" for size in sizes], rotation=45, fontsize="x-small")
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.4g}")
            axes.grid(alpha=0.3)
    figure.savefig(file, dpi=150)


if __name__ == "__main__":
    exit_with(main)
