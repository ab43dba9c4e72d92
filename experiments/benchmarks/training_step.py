"""Where the time of an environment step goes: `python -m experiments.benchmarks.training_step`.

One seed of APT-Gen on Grid-World A.  Each part of an iteration is timed by itself in a compiled loop, from a state that
training has reached, and the whole chunk as it is: what the whole takes beyond the sum of its parts is lost between them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
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
    """Time the parts of a training step, and what share of the machine's matmul rate the policy updates reach.

    Attributes:
      presets: what to time.
      cores: cores that the process may use.
      at_least: seconds that one measurement of a part takes at least.
    """

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
class PolicyUpdate:
    """One policy update against the rate of `Matmul`s as large as its largest.

    Attributes:
      matmul_flops: operations of its matmuls, from the shapes in its jaxpr.
      compiled_flops: all its operations as the compiler estimates them.
      matmul_share: of the matmul rate that its matmuls are done at; everything else it does lowers the share.
      matmul_share_with_sampling: the same with the time to sample its batch added.
      own_shapes_share: the share that its matmuls would reach if nothing else took any time, each as fast as its own shape
        alone: the rest up to 1 is owed to matrices smaller than the one that the rate is of.
    """

    matmul_flops: int
    compiled_flops: float
    matmul_share: float
    matmul_share_with_sampling: float
    own_shapes_share: float


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
    """

    config: Config
    parts: dict[str, Timing]
    chunk: Timing
    shortest_chunk: Timing
    model_update: Timing
    models: dict[str, Timing]
    policy_update: PolicyUpdate

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
    problems = {preset: _measure.load_problem(preset, **(_measure.QUICK if args.quick else {})) for preset in args.presets}
    results = {preset: measure(problem, args, rate=matmuls[0].rate) for preset, problem in problems.items()}
    text = "\n".join([matmul_table(matmuls), *(tables(preset, result) for preset, result in results.items())])
    _measure.report("training_step", args, {"matmuls": matmuls, "presets": results}, text)
    return 0


def time_matmul(rows: int, inner: int, columns: int, args: Args) -> Matmul:
    """The rate of one shape of matmul."""
    timing, flops = _flops.time_matmuls(rows, inner, columns, repeats=args.repeats, at_least=args.at_least)
    return Matmul(rows, inner, columns, timing, flops)


def measure(problem: Problem, args: Args, *, rate: float) -> Result:
    """Everything about one preset; `rate`, in operations per second, is what policy updates are compared with."""
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
    evaluation = dataclasses.replace(shortest, seconds=tuple(max(seconds - others, 0.0) for seconds in shortest.seconds))
    parts["evaluate"] = evaluation.per(config.eval_every)

    batches, _ = pieces["update policy"].fixed
    batch = jax.tree.map(lambda x: x[0], batches)
    update = partial(_parts.policy_update, problem)
    shapes = _flops.matmuls(update, state, batch)
    matmul_flops = _flops.matmul_flops(update, state, batch)
    own_shapes = sum(count * time_matmul(*shape, args).timing.median / 2 for shape, count in shapes.items())
    useful = config.updates_per_step * matmul_flops / rate  # seconds per environment step, were all else free
    return Result(
        config=config,
        parts=parts,
        chunk=chunk.per(config.eval_every),
        shortest_chunk=shortest,
        model_update=timings["update models"].per(round(config.model_updates_per_step * steps)),
        models={name: time_part(piece) for name, piece in _parts.model_parts(problem, state, clock).items()},
        policy_update=PolicyUpdate(
            matmul_flops=matmul_flops,
            compiled_flops=_flops.compiled_flops(update, state, batch),
            matmul_share=useful / parts["update policy"].median,
            matmul_share_with_sampling=useful / (parts["update policy"].median + parts["sample"].median),
            own_shapes_share=matmul_flops / rate / own_shapes,
        ),
    )


def start(problem: Problem) -> tuple[TrainState, Clock]:
    """The state after warm-up."""
    trainer = make_trainer(problem.space, problem.target, problem.config)
    state = jax.jit(trainer.init)(jax.random.key(0), problem.hparams)
    return jax.jit(trainer.warmup, donate_argnums=0)(state, Clock.start(), problem.hparams)


def time_chunk(problem: Problem, state: TrainState, clock: Clock, repeats: int) -> tuple[Timing, tuple[Any, ...]]:
    """The time of a chunk, and the state and clock after all repeats."""
    trainer = make_trainer(problem.space, problem.target, problem.config)
    return _measure.time_calls(trainer.chunk, (state, clock), problem.hparams, repeats=repeats)


def matmul_table(matmuls: list[Matmul]) -> str:
    """The machine's matmul rates."""
    rows = [
        [f"[{m.rows}, {m.inner}] x [{m.inner}, {m.columns}]", m.timing.per(2).cell(1e-6), f"{m.rate / 1e9:.1f}"]
        for m in matmuls
    ]
    return _measure.table(["float32 matmul", "microseconds", "GFLOP/s"], rows)


def tables(preset: str, result: Result) -> str:
    """A preset's results, for people."""
    chunk, total, policy = result.chunk, result.sum_of_parts, result.policy_update
    rows = [
        [name, timing.cell(), f"{timing.median / total:.1%}", f"{timing.compile_seconds:.1f}"]
        for name, timing in result.parts.items()
    ]
    training = chunk.median - result.parts["evaluate"].median
    rows += [
        ["sum of the parts", _measure.number(total * 1e3), "100.0%", ""],
        ["whole chunk", chunk.cell(), f"{chunk.median / total:.1%}", f"{chunk.compile_seconds:.1f}"],
        ["whole chunk less evaluation", _measure.number(training * 1e3), f"{training / total:.1%}", ""],
    ]
    pieces = {**result.models, "all of it, jointly": result.model_update}
    alone = sum(timing.median for timing in result.models.values())
    model_rows = [[name, timing.cell(), f"{timing.median / alone:.1%}"] for name, timing in pieces.items()]
    return "\n".join(
        [
            f"Preset {preset}, milliseconds per environment step, median (range):\n",
            _measure.table([f"{preset}: part", "ms per step", "of the sum", "compile, s"], rows),
            f"Whole / sum of the parts: {chunk.median / total:.3f}.\n",
            _measure.table([f"{preset}: piece of a model update", "ms", "of the pieces' sum"], model_rows),
            f"A policy update does {policy.matmul_flops / 1e6:.1f} MFLOP in matmuls ({policy.compiled_flops / 1e6:.1f} MFLOP "
            f"in all by the compiler's count), at {policy.matmul_share:.1%} of the rate of the first matmul above; "
            f"{policy.matmul_share_with_sampling:.1%} with sampling.  Its matmuls alone, each at the rate of its own shape, "
            f"would reach {policy.own_shapes_share:.1%}.\n",
        ]
    )


if __name__ == "__main__":
    exit_with(main)
