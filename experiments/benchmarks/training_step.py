"""Where the time of an environment step goes: `python -m experiments.benchmarks.training_step`.

One seed of APT-Gen on target A of a space.  Each part of an iteration is timed by itself in a compiled loop, from a state that
training has reached, and the whole chunk as it is: what the whole takes beyond the sum of its parts is lost between them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Literal

import jax
import tyro

from apt_jax.config import Config
from apt_jax.trainer import Clock, TrainState, make_trainer
from experiments.benchmarks import _flops, _measure, _parts
from experiments.benchmarks._measure import Options, Problem, Timing
from experiments.errors import exit_with

MERGE_MATMUL = (128, 192, 128)
LARGE_MATMUL = (1024, 1024, 1024)
"""Rows, inner size and columns: the Q-network's largest layer on a batch, and a matmul that is as fast as they come."""


@dataclass(frozen=True)
class Args(Options):
    """Time the parts of a training step, and what share of the machine's matmul rate they reach.

    Attributes:
      space: where to train.
      presets: what to time.
      cores: cores that the process may use.
      at_least: seconds that one measurement of a part takes at least.
    """

    space: Literal["grid_world", "manipulation"] = "grid_world"
    presets: tuple[Literal["paper", "fast"], ...] = ("paper", "fast")
    cores: int = 1
    at_least: float = 0.3


@dataclass(frozen=True)
class Matmul:
    """How fast the machine multiplies [rows, inner] by [inner, columns] matrices.

    Attributes:
      flops: operations of the pair of products that `timing` is of.
    """

    rows: int
    inner: int
    columns: int
    timing: Timing
    flops: int

    @property
    def rate(self) -> float:
        """Operations per second."""
        return self.flops / self.timing.median


@dataclass(frozen=True)
class Work:
    """The operations of something, and how long it takes.

    Attributes:
      flops: all operations as the compiler estimates them.
      matmul_flops: those of its matmuls, from the shapes in its jaxpr.
      matmul_seconds: what its matmuls would take by themselves, each at the rate of its own shape.
      seconds: what it takes.
    """

    flops: float
    matmul_flops: float
    matmul_seconds: float
    seconds: float

    def times(self, count: float) -> Work:
        """So many of it."""
        return Work(*(count * value for value in dataclasses.astuple(self)))


@dataclass(frozen=True)
class Result:
    """What was measured of one preset.

    Attributes:
      config: the preset.
      parts: of a chunk, per environment step.
      chunk: the whole, per environment step.
      shortest_chunk: a chunk of one iteration; without the parts of an iteration it gives the evaluation's time.
      model_update: one round of `curriculum.update`.
      models: pieces of such a round, each alone.
      work: of one update of each kind, and of an environment step without its share of the evaluation.
    """

    config: Config
    parts: dict[str, Timing]
    chunk: Timing
    shortest_chunk: Timing
    model_update: Timing
    models: dict[str, Timing]
    work: dict[str, Work]

    @property
    def sum_of_parts(self) -> float:
        """Seconds per environment step."""
        return sum(timing.median for timing in self.parts.values())


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.training_step")
    _measure.check(args)
    _measure.pin(args.cores)
    # No compilation cache: the seconds to compile are results too.
    jax.config.update("jax_num_cpu_devices", 1)
    if args.quick:
        args = dataclasses.replace(args, repeats=1, at_least=0.0)
    matmuls = [time_matmul(*shape, args) for shape in (MERGE_MATMUL, LARGE_MATMUL)]
    changes = _measure.QUICK if args.quick else {}
    problems = {preset: _measure.load_problem(preset, space=args.space, **changes) for preset in args.presets}
    results: dict[str, Result] = {preset: measure(problem, args) for preset, problem in problems.items()}
    rate = matmuls[0].rate
    text = f"{matmul_table(matmuls)}\n{tables(results, rate)}"
    name = "training_step" if args.space == "grid_world" else f"training_step_{args.space}"
    _measure.report(name, args, {"matmuls": matmuls, "presets": results}, text)
    return 0


@cache
def time_matmul(rows: int, inner: int, columns: int, args: Args) -> Matmul:
    """The rate of one shape of matmul; parts have many shapes in common."""
    timing, flops = _flops.time_matmuls(rows, inner, columns, repeats=args.repeats, at_least=args.at_least)
    return Matmul(rows, inner, columns, timing, flops)


def measure(problem: Problem, args: Args) -> Result:
    """Everything about one preset."""
    config = problem.config
    steps = _parts.SOURCES * config.envs_per_source
    chunk, (state, clock) = time_chunk(problem, *start(problem), args.repeats)

    pieces = _parts.iteration_parts(problem, state, clock)
    time_part = partial(_parts.time_part, clock=clock, repeats=args.repeats, at_least=args.at_least)
    timings = {name: time_part(piece) for name, piece in pieces.items()}
    parts = {name: timing.per(config.refresh_every if name == "refresh" else steps) for name, timing in timings.items()}

    # One iteration, one refresh and one evaluation: what the parts leave of it is the evaluation.
    single = problem._replace(config=dataclasses.replace(config, refresh_every=steps, eval_every=steps))
    shortest, _ = time_chunk(single, state, clock, args.repeats)
    others = sum(timing.median for timing in timings.values())
    evaluation = Timing(tuple(max(seconds - others, 0.0) for seconds in shortest.seconds), 0.0)  # never compiled by itself
    parts["evaluate"] = evaluation.per(config.eval_every)

    chunk = chunk.per(config.eval_every)
    model_pieces = _parts.model_parts(problem, state, clock)
    models = {name: time_part(piece) for name, piece in model_pieces.items()}
    model_update = timings["update models"].per(round(config.model_updates_per_step * steps))

    batches, _ = pieces["update policy"].fixed
    batch = jax.tree.map(lambda x: x[0], batches)
    policy_seconds = parts["update policy"].median / config.updates_per_step
    work = {"policy update": count(partial(_parts.policy_update, problem), state, batch, seconds=policy_seconds, args=args)}
    for name in ("discriminator", "values", "generator"):
        piece = model_pieces[name]
        inputs = piece.state, piece.fixed, jax.random.key(0), clock.iteration
        work[name] = count(piece.step, *inputs, seconds=models[name].median, args=args)
    policy, *alone = work.values()
    work["the last three, jointly"] = together(alone, seconds=model_update.median)
    work["environment step"] = together(
        [policy.times(config.updates_per_step), *(piece.times(config.model_updates_per_step) for piece in alone)],
        seconds=chunk.median - parts["evaluate"].median,
    )
    return Result(config, parts, chunk, shortest, model_update, models, work)


def count(function: Callable[..., Any], *inputs: Any, seconds: float, args: Args) -> Work:
    """The work of a function without loops that takes `seconds`."""
    shapes = _flops.matmuls(function, *inputs)
    return Work(
        flops=_flops.compiled_flops(function, *inputs),
        matmul_flops=_flops.matmul_flops(function, *inputs),
        matmul_seconds=sum(n * time_matmul(*shape, args).timing.median / 2 for shape, n in shapes.items()),
        seconds=seconds,
    )


def together(pieces: Sequence[Work], *, seconds: float) -> Work:
    """What several do, in `seconds`."""
    sums = [sum(values) for values in zip(*map(dataclasses.astuple, pieces), strict=True)]
    return dataclasses.replace(Work(*sums), seconds=seconds)


def start(problem: Problem) -> tuple[TrainState, Clock]:
    """The state after warm-up."""
    trainer = make_trainer(problem.space, problem.config)
    state = jax.jit(trainer.init)(jax.random.key(0), problem.target, problem.hparams)
    return jax.jit(trainer.warmup, donate_argnums=0)(state, Clock.start(), problem.hparams)


def time_chunk(problem: Problem, state: TrainState, clock: Clock, repeats: int) -> tuple[Timing, tuple[Any, ...]]:
    """The time of a chunk, and the state and clock after all repeats."""
    trainer = make_trainer(problem.space, problem.config)
    return _measure.time_calls(trainer.chunk, (state, clock), problem.hparams, repeats=repeats)


def matmul_table(matmuls: list[Matmul]) -> str:
    """The machine's matmul rates."""
    rows = [
        [f"[{m.rows}, {m.inner}] x [{m.inner}, {m.columns}]", m.timing.per(2).cell(1e-6), f"{m.rate / 1e9:.1f}"]
        for m in matmuls
    ]
    return _measure.table(["float32 matmul", "microseconds", "GFLOP/s"], rows)


def tables(results: Mapping[str, Result], rate: float) -> str:
    """The results of each preset side by side, for people; `rate` is that of the first matmul, in operations per second."""
    sums = ", ".join(f"{r.chunk.median / r.sum_of_parts:.2f} ({preset})" for preset, r in results.items())
    return "\n".join(
        [
            "Milliseconds per environment step:\n",
            side_by_side("part", ["ms", "of the sum", "compile, s"], {name: part_rows(r) for name, r in results.items()}),
            f"Whole / sum of the parts: {sums}.\n",
            side_by_side("piece of a model update", ["ms", "of the sum"], {name: model_rows(r) for name, r in results.items()}),
            "What matmuls reach, all else that is done counted as time lost:\n",
            side_by_side(
                "one",
                ["MFLOP in matmuls", "of the rate", "of its own shapes"],
                {name: work_rows(r.work, rate) for name, r in results.items()},
            ),
        ]
    )


Rows = dict[str, list[str]]
"""Cells by the name of their row."""


def side_by_side(first: str, columns: Sequence[str], presets: Mapping[str, Rows]) -> str:
    """One table of the same rows and columns of several presets."""
    header = [first, *(f"{preset}: {column}" for preset in presets for column in columns)]
    names = next(iter(presets.values()))
    return _measure.table(header, [[name, *(cell for rows in presets.values() for cell in rows[name])] for name in names])


def part_rows(result: Result) -> Rows:
    """What the parts take, together and within the whole."""
    chunk, total = result.chunk, result.sum_of_parts
    training = chunk.median - result.parts["evaluate"].median
    return {
        **{
            name: [
                timing.cell(),
                f"{timing.median / total:.1%}",
                f"{timing.compile_seconds:.1f}" if timing.compile_seconds else "",
            ]
            for name, timing in result.parts.items()
        },
        "sum of the parts": [_measure.number(total * 1e3), "100.0%", ""],
        "whole chunk": [chunk.cell(), f"{chunk.median / total:.1%}", f"{chunk.compile_seconds:.1f}"],
        "whole chunk less evaluation": [_measure.number(training * 1e3), f"{training / total:.1%}", ""],
    }


def model_rows(result: Result) -> Rows:
    """What the pieces of a model update take, each alone and all jointly."""
    pieces = {**result.models, "all of it, jointly": result.model_update}
    alone = sum(timing.median for timing in result.models.values())
    return {name: [timing.cell(), f"{timing.median / alone:.1%}"] for name, timing in pieces.items()}


def work_rows(work: Mapping[str, Work], rate: float) -> Rows:
    """How much of the machine's matmul rate is reached, if all that is no matmul counts as lost time."""
    return {
        name: [
            _measure.number(one.matmul_flops / 1e6),
            f"{one.matmul_flops / one.seconds / rate:.1%}",
            f"{one.matmul_seconds / one.seconds:.1%}",
        ]
        for name, one in work.items()
    }


if __name__ == "__main__":
    exit_with(main)
