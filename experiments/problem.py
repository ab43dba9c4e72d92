"""From an experiment's names to the objects they stand for."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import envs
from apt_jax.checks import check_target
from apt_jax.config import Config, HParams
from apt_jax.curricula.apt_gen import AptGenState
from apt_jax.lanes import lane_struct
from apt_jax.trainer import Clock, Trainer, make_trainer
from experiments.errors import UsageError
from experiments.settings import Experiment, make_space


class Problem(NamedTuple):
    """A task space, a target task of it, and the trainer for both."""

    space: envs.BenchmarkSpace
    target: Any
    trainer: Trainer


def load_target(space: str, name: str, file: Path | None) -> Any:
    """The target task of a file, if one is given, else of a name; raises a `UsageError` if there is none, or no solution."""
    if not file and Path(name).suffix:
        raise UsageError(f"--target {name} is no file")
    try:
        if not file:
            return envs.load_target(space, name)
        target = envs.load_target_file(space, file)
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    own = make_space(space)
    if not jax.jit(own.describe)(target, target).get("feasible", True):
        raise UsageError(f"{file}: no {own.horizon} steps, an episode's longest, solve this task")
    return target


def import_plugins(names: Iterable[str]) -> None:
    """Imports modules that register what they add; raises a `UsageError` for one that is not there."""
    for name in names:
        try:
            import_module(name)
        except ModuleNotFoundError as error:
            raise UsageError(f"--plugins {name}: {error}") from error


def make_problem(experiment: Experiment) -> Problem:
    """Imports plug-ins and checks every name and size before anything is compiled; raises a `UsageError`."""
    import_plugins(experiment.plugins)
    space = make_space(experiment.space)
    if experiment.target_file == Path(experiment.target) and experiment.target in space.targets:
        raise UsageError(f"--target {experiment.target} is both a target of {space.name} and a file here; rename the file")
    target = load_target(experiment.space, experiment.target, experiment.target_file)
    try:
        problem = Problem(space, target, make_trainer(space, experiment.config))
        check_target(space, target)
        if experiment.plugins:
            check_traces(problem.trainer)
    except ValueError as error:
        raise UsageError(str(error)) from error
    check_env_steps(experiment.env_steps, experiment.config)
    return problem


def check_traces(trainer: Trainer) -> None:
    """Raises what tracing the warm-up does, a `ValueError` where a task space's `step` is not as it should be."""
    jax.eval_shape(trainer.warmup, lane_struct(trainer), Clock.start(), jax.tree.map(jnp.float32, HParams()))


def check_apt_gen(trainer: Trainer, run: Path) -> None:
    """Raises a `UsageError` unless the curriculum of a run is APT-Gen's, which has models to be asked."""
    if not isinstance(lane_struct(trainer).curriculum, AptGenState):
        raise UsageError(f"{run} is no run of apt_gen but of {trainer.config.method}")


def check_env_steps(env_steps: int, config: Config) -> None:
    """Raises a `UsageError` unless warm-up and a whole number of chunks make up `env_steps`, and the clock can count so far."""
    if env_steps >= 2**31:
        raise UsageError(f"--env-steps must be below 2^31, got {env_steps}")
    chunks = max(round((env_steps - config.warmup_steps) / config.eval_every), 1)
    closest = config.warmup_steps + chunks * config.eval_every
    if env_steps != closest:
        raise UsageError(
            f"--env-steps must exceed warmup_steps ({config.warmup_steps}) by a multiple of eval_every ({config.eval_every}); "
            f"closest to {env_steps} is {closest}"
        )
