"""All lanes of one experiment on the devices at hand: advance, save, restore."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec, Sharding
from jaxtyping import Array, Float, Int, Key

from apt_jax import checkpoint
from apt_jax.config import HParams
from apt_jax.lanes import Layout, make_program, stack_hparams
from apt_jax.specs import Params
from apt_jax.trainer import Clock, Trainer, TrainState
from experiments.errors import UsageError
from experiments.settings import Experiment

_PROPOSE_STREAM = 1_000_003
"""Sampling tasks for pictures draws from a stream of its own."""


class Runner:
    """Holds the states of L lanes and the compiled functions that change them."""

    def __init__(self, trainer: Trainer, experiment: Experiment, layout: Layout, at_once: int | None = None):
        self._lanes = len(experiment.lanes)
        self._trainer = trainer
        self._program = make_program(trainer, self._lanes, layout=layout, at_once=at_once)
        self._keys, self._hparams = lane_inputs(experiment)
        self._propose = jax.jit(jax.vmap(trainer.propose, in_axes=(0, 0, None, 0)), static_argnums=2)
        self._states: TrainState
        self._clock: Clock
        self._warmup: Callable[..., Any] = self._program.warmup
        self._chunk: Callable[..., Any] = self._program.chunk
        self.generates = trainer.generates
        self.env_steps = 0

    def init(self) -> float:
        """Fresh states, before anything else; returns the seconds that compiling took."""
        began = time.monotonic()
        init = _compile(self._program.init, self._keys, self._hparams)
        seconds = time.monotonic() - began
        self._states = init(self._keys, self._hparams)
        self._clock = jax.device_put(Clock.start(), _replicated(self._states))
        return seconds

    def compile(self) -> float:
        """Compiles what is still to run ahead of time; returns the seconds that took."""
        began = time.monotonic()
        if not self.env_steps:
            self._warmup = _compile(self._program.warmup, self._states, self._clock, self._hparams)
        self._chunk = _compile(self._program.chunk, self._states, self._clock, self._hparams)
        return time.monotonic() - began

    def warmup(self) -> None:
        """The steps before any update."""
        self._states, self._clock = self._warmup(self._states, self._clock, self._hparams)
        self.env_steps = int(self._clock.env_steps)

    def advance(self) -> dict[str, Float[np.ndarray, "L"]]:
        """One chunk; returns its metrics once they are there."""
        self._states, self._clock, metrics = self._chunk(self._states, self._clock, self._hparams)
        self.env_steps = int(self._clock.env_steps)
        return jax.device_get(metrics)

    def propose(self, n: int) -> Params:
        """`n` tasks that each lane's curriculum would generate now, leaves [L, n, ...]."""
        keys = jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, _PROPOSE_STREAM), self.env_steps))(self._keys)
        rows = self._states.key.shape[0]
        keys, hparams = jax.tree.map(lambda x: _pad(x, rows), (keys, self._hparams))
        w = self._propose(self._states, keys, n, hparams)
        return self._first(w)

    @property
    def policies(self) -> Any:
        """Q-network parameters, leaves [L, ...]."""
        return self._first(self._states.learner.params)

    def save(self, directory: Path) -> None:
        """A checkpoint of the L lanes and the clock, whatever they are padded to on these devices."""
        tree = (self._first(self._states), self._clock)
        checkpoint.save(directory, self.env_steps, jax.device_put(tree, jax.devices()[0]))

    def restore(self, directory: Path) -> None:
        """Goes on from a checkpoint, also one from a machine with other devices."""
        states, self._clock = load_states(directory, self._trainer, self._keys, self._hparams, self._clock.env_steps.sharding)
        shardings = jax.tree.map(lambda x: x.sharding, self._states)
        self._states = jax.jit(partial(_pad, length=self._states.key.shape[0]), out_shardings=shardings)(states)
        self.env_steps = int(self._clock.env_steps)

    def _first(self, tree: Any) -> Any:
        """Without the lanes that only pad."""
        return _take(tree, np.arange(self._lanes))


def lane_inputs(experiment: Experiment) -> tuple[Key[Array, "L"], HParams]:
    """Key, which depends on nothing but the seed, and hyper-parameters (leaves [L]) of every lane."""
    keys = jax.vmap(jax.random.key)(np.asarray([lane.seed for lane in experiment.lanes]))
    return keys, stack_hparams([lane.hparams for lane in experiment.lanes])


def load_states(
    directory: Path, trainer: Trainer, keys: Key[Array, "L"], hparams: HParams, sharding: Sharding
) -> tuple[TrainState, Clock]:
    """The states of a checkpoint, leaves [L, ...], and its clock, both placed by `sharding`.

    Raises:
      UsageError: there is none, or it cannot be read.
    """
    shapes = jax.eval_shape(jax.vmap(trainer.init), keys, hparams), jax.eval_shape(Clock.start)
    placed = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), shapes)
    try:
        return checkpoint.restore(directory, placed)
    except checkpoint.CheckpointError as error:
        raise UsageError(str(error)) from error


def _replicated(states: TrainState) -> NamedSharding:
    """The placement of what all lanes share, on the devices of `states`."""
    return NamedSharding(cast(NamedSharding, states.key.sharding).mesh, PartitionSpec())


def _pad(tree: Any, length: int) -> Any:
    """Repeats the last lane up to `length` lanes."""
    lanes = jax.tree.leaves(tree)[0].shape[0]
    return _take(tree, np.minimum(np.arange(length), lanes - 1))


@jax.jit
def _take(tree: Any, lanes: Int[Array, "N"]) -> Any:
    """Lanes of every leaf; one compiled call, because one per leaf shape costs seconds."""
    return jax.tree.map(lambda x: x[lanes], tree)


def _compile(function: Callable[..., Any], *args: Any) -> Callable[..., Any]:
    return cast(jax.stages.Wrapped, function).lower(*args).compile()
