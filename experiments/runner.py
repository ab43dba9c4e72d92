"""All lanes of one experiment on the devices at hand, of this process or of several: advance, save, restore."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Key

from apt_jax import checkpoint
from apt_jax.config import HParams
from apt_jax.lanes import Layout, lane_bytes, make_program, room, stack_hparams, stack_targets
from apt_jax.specs import Params
from apt_jax.task_space import task_struct
from apt_jax.trainer import Clock, Trainer, TrainState
from apt_jax.turns import Turns
from experiments import processes, runtime
from experiments.errors import UsageError
from experiments.programs import Programs
from experiments.run_dir import RunDir
from experiments.settings import Experiment

_PROPOSE_STREAM = 1_000_003
"""Sampling tasks for pictures draws from a stream of its own."""


class Runner:
    """Holds the states of L lanes and the compiled functions that change them; processes call its methods together.

    Raises:
      UsageError: fewer lanes than processes, or more than there is room for where they cannot take turns (`make_program`).
    """

    def __init__(
        self,
        trainer: Trainer,
        target: Any,
        experiment: Experiment,
        layout: Layout,
        programs: Programs | None = None,
    ):
        self._lanes = len(experiment.lanes)
        self._trainer = trainer
        memory = runtime.device_memory()
        resident = None if memory is None else room(trainer, memory)
        try:
            self._program = make_program(trainer, self._lanes, layout=layout, resident=resident)
        except ValueError as error:
            raise UsageError(str(error)) from error
        self._keys, self._hparams = lane_inputs(experiment)
        self._targets = stack_targets([target] * self._lanes)
        self._propose = jax.jit(jax.vmap(trainer.propose, in_axes=(0, 0, None, 0)), static_argnums=2)
        self._states: TrainState
        self._clock: Clock
        self.programs = programs or Programs()
        self._warmup = self._program.warmup
        self._chunk = self._program.chunk
        self.generates = trainer.generates
        self.env_steps = 0

    @property
    def placement(self) -> str:
        """How large the lanes are, and where they are if not all fit the devices."""
        size = f"{self._lanes} lane{'s' * (self._lanes > 1)} of {lane_bytes(self._trainer) / 2**20:.1f} MiB"
        if not isinstance(self._program.chunk, Turns):
            return size
        group = self._program.chunk.group
        return f"{size} do not fit the devices' memory: {group} at a time take turns, the others wait in the host's"

    def init(self) -> float:
        """Fresh states, before anything else; returns the seconds that compiling took."""
        began = time.monotonic()
        args = self._keys, self._targets, self._hparams
        init = self.programs.compile("init", self._program.init, *args)
        seconds = time.monotonic() - began
        self._states = init(*args)
        self._clock = jax.device_put(Clock.start(), NamedSharding(self._mesh, PartitionSpec()))
        return seconds

    def compile(self) -> float:
        """Compiles what is still to run ahead of time; returns the seconds that took."""
        began = time.monotonic()
        args = (self._states, self._clock, self._hparams)
        warmup = {} if self.env_steps else {"warmup": self._program.warmup}
        compiled = self.programs.compile_all({**warmup, "chunk": self._program.chunk}, *args)
        self._chunk, self._warmup = compiled["chunk"], compiled.get("warmup", self._warmup)
        return time.monotonic() - began

    def warmup(self) -> None:
        """The steps before any update."""
        self._states, self._clock = self._warmup(self._states, self._clock, self._hparams)
        self.env_steps = int(self._clock.env_steps)

    def advance(self) -> dict[str, Float[np.ndarray, "L"]]:
        """One chunk; returns its metrics once they are there."""
        self._states, self._clock, metrics = self._chunk(self._states, self._clock, self._hparams)
        self.env_steps = int(self._clock.env_steps)
        return self._gather(metrics)

    def propose(self, n: int) -> Params:
        """`n` tasks that each lane's curriculum would generate now, leaves [L, n, ...]."""
        keys = jax.vmap(lambda key: jax.random.fold_in(jax.random.fold_in(key, _PROPOSE_STREAM), self.env_steps))(self._keys)
        lanes = _padded(self._lanes, self._rows)
        keys, hparams = jax.tree.map(lambda x: x[lanes], (keys, self._hparams))
        return self._gather(self._propose(self._states, keys, n, hparams))

    def policies(self) -> Any:
        """Parameters of the kept policies, leaves [L, ...]."""
        return self._gather(self._states.policy)

    def save(self, directory: Path) -> None:
        """A checkpoint of the lanes, as they are padded on these devices, and the clock."""
        checkpoint.save(directory, self.env_steps, (self._states, self._clock))

    def restore(self, directory: Path) -> None:
        """Goes on from a checkpoint, also one from other devices or of another number of processes."""
        rows, mesh, shardings = self._rows, self._mesh, jax.tree.map(lambda x: x.sharding, self._states)
        del self._states  # its place is needed
        states, self._clock = load_states(directory, self._trainer, self._keys, self._hparams, mesh)
        if states.key.shape[0] != rows:
            lanes = _padded(self._lanes, rows)
            states = jax.jit(lambda tree: jax.tree.map(lambda x: x[lanes], tree), out_shardings=shardings)(states)
        self._states = states
        self.env_steps = int(self._clock.env_steps)

    @property
    def _rows(self) -> int:
        """How many lanes there are with those that only pad."""
        return self._states.key.shape[0]

    @property
    def _mesh(self) -> Mesh:
        return cast(Mesh, cast(NamedSharding, self._states.key.sharding).mesh)

    def _gather(self, tree: Any) -> Any:
        """Leaves [L, ...] as numpy, without the lanes that only pad."""
        return jax.tree.map(lambda x: x[: self._lanes], processes.gather(tree))


def lane_inputs(experiment: Experiment) -> tuple[Key[Array, "L"], HParams]:
    """Key, which depends on nothing but the seed, and hyper-parameters (leaves [L]) of every lane."""
    keys = jax.vmap(jax.random.key)(np.asarray([lane.seed for lane in experiment.lanes]))
    return keys, stack_hparams([lane.hparams for lane in experiment.lanes])


def load_lanes(directory: Path, experiment: Experiment, trainer: Trainer) -> tuple[TrainState, Clock, HParams]:
    """States and hyper-parameters (leaves [L, ...]) of a run directory's latest checkpoint, and its clock.

    They are in the host's memory, because a run may have more lanes than fit a device: what is used has to be put there.

    Raises:
      UsageError: there is none, or it cannot be read.
    """
    keys, hparams = lane_inputs(experiment)
    host = Mesh(np.array([runtime.host()]), ("lane",))
    states, clock = load_states(RunDir(directory).checkpoints, trainer, keys, hparams, host)
    return jax.tree.map(lambda x: x[: len(experiment.lanes)], states), clock, hparams


def load_states(
    directory: Path, trainer: Trainer, keys: Key[Array, "L"], hparams: HParams, mesh: Mesh
) -> tuple[TrainState, Clock]:
    """The states of a checkpoint, padded as they were saved (leaves [R, ...], R >= L), and its clock, on the devices of a mesh.

    Raises:
      UsageError: there is none, or it cannot be read.
    """
    init = jax.vmap(trainer.init, in_axes=(0, None, 0))
    states, clock = jax.eval_shape(init, keys, task_struct(trainer.space), hparams), jax.eval_shape(Clock.start)
    try:
        rows = checkpoint.rows(directory)
        by_lane, shared = NamedSharding(_even(mesh, rows), PartitionSpec("lane")), NamedSharding(mesh, PartitionSpec())
        template = (
            jax.tree.map(lambda x: jax.ShapeDtypeStruct((rows, *x.shape[1:]), x.dtype, sharding=by_lane), states),
            jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=shared), clock),
        )
        return checkpoint.restore(directory, template)
    except checkpoint.CheckpointError as error:
        raise UsageError(str(error)) from error


def _even(mesh: Mesh, rows: int) -> Mesh:
    """The devices of a mesh, in groups that hold copies if `rows` cannot be divided by all of them."""
    groups = math.gcd(rows, mesh.size)
    if groups == mesh.size:
        return mesh
    return Mesh(mesh.devices.reshape(groups, -1), ("lane", "copy"))


def _padded(lanes: int, rows: int) -> np.ndarray:
    """The lane of each row: the last one pads."""
    return np.minimum(np.arange(rows), lanes - 1)
