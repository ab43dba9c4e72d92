"""Many seeds, targets and hyper-parameters as lanes of one compiled program.

A lane is one (key, target, HParams).  The functions of `apt_jax.trainer` know nothing of lanes; here they are batched, sharded
over devices, also those of other hosts, and jitted.  The program has no collectives, so no device ever waits for another (one
CPU device that waits for another longer than a minute ends the process: XLA takes it for a deadlock).

Within a device, lanes run side by side ("vmap", for accelerators) or one after another ("map", for CPUs: with a device per core
both take as long, and "map" computes in every lane what it computes alone; BENCHMARKS.md, "Many seeds").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain, islice, zip_longest
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int, Key

from apt_jax.config import HParams, check_hparams
from apt_jax.task_space import task_struct
from apt_jax.trainer import Clock, Trainer, TrainState
from apt_jax.turns import Turns, check_lanes

Layout = Literal["auto", "vmap", "map"]

LaneMetrics = dict[str, Float[Array, "L"]]
"""`Metrics` of every lane, by name."""


class Program(NamedTuple):
    """A trainer over L lanes, jitted; states are donated: after a call only the returned one is valid.

    States and metrics hold at least L lanes: the last is repeated up to a multiple of the devices.  Keys, targets or hparams of
    another number of lanes raise a `ValueError`, as does a target that is not like the space's tasks.

    Attributes:
      init: `init(keys, targets, hparams) -> states`, for keys [L], and targets and hparams with leaves [L, ...]; of several
        devices none may be committed to one.
      warmup: `warmup(states, clock, hparams) -> (states, clock)`, from `Clock.start()`, once before any chunk: there is nothing
        to learn from without it.
      chunk: `chunk(states, clock, hparams) -> (states, clock, metrics)`.
    """

    init: Callable[[Key[Array, "L"], Any, HParams], TrainState]
    warmup: Callable[[TrainState, Clock, HParams], tuple[TrainState, Clock]]
    chunk: Callable[[TrainState, Clock, HParams], tuple[TrainState, Clock, LaneMetrics]]


def stack_hparams(hparams: Sequence[HParams]) -> HParams:
    """HParams of single lanes as one with leaves float32 [L].

    Raises:
      ValueError: no lane, or a value out of its range (`check_hparams`).
    """
    if not hparams:
        raise ValueError("there must be at least one lane")
    for lane in hparams:
        check_hparams(lane)
    return jax.tree.map(lambda *leaves: np.asarray(leaves, np.float32), *hparams)


def stack_targets(targets: Sequence[Any]) -> Any:
    """Target tasks of single lanes, all of one space, as one with leaves [L, ...].

    Raises:
      ValueError: no lane.
    """
    if not targets:
        raise ValueError("there must be at least one lane")
    return jax.tree.map(lambda *leaves: np.stack([jnp.asarray(x) for x in leaves]), *targets)


def make_program(
    trainer: Trainer,
    lanes: int,
    *,
    layout: Layout = "auto",
    resident: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Program:
    """Batch a trainer over `lanes`.

    Args:
      layout: how the lanes of one device are laid out; "auto" is "map" on CPU and "vmap" elsewhere.
      resident: lanes that one device's memory has room for; if there are more, groups of them take turns (`apt_jax.turns`), and
        states are kept by the host.  All fit by default.
      devices: what to shard lanes over, by default every device of every process; no more are used than there are lanes.

    Raises:
      ValueError: fewer than one lane, or room for none, or fewer lanes than processes, or several processes with more lanes
        than there is room for, or no CPU among JAX's platforms where lanes take turns; no devices, or an unknown layout.
    """
    if lanes < 1:
        raise ValueError(f"a program needs at least one lane, got {lanes}")
    if resident is not None and resident < 1:
        raise ValueError(f"resident must be at least 1 lane per device, got {resident}")
    if layout not in get_args(Layout):
        raise ValueError(f"layout must be one of {', '.join(get_args(Layout))}, got {layout!r}")
    devices = jax.devices() if devices is None else devices
    if not devices:
        raise ValueError("a program needs at least one device")
    used = _spread(devices, lanes)
    if resident is not None and lanes > resident * len(used):
        group = resident * len(used)
        if len({device.process_index for device in used}) > 1:
            raise ValueError(f"the devices have room for {group} lanes, got {lanes}: take more hosts, or fewer seeds at a time")
        try:
            jax.devices("cpu")
        except RuntimeError as error:
            raise ValueError(
                f"the devices have room for {group} lanes, got {lanes}, and the others cannot wait in the host's memory: "
                "JAX_PLATFORMS leaves the CPU out; add it, as in JAX_PLATFORMS=cuda,cpu"
            ) from error
        program = make_program(trainer, group, layout=layout, devices=used)
        mesh = Mesh(np.array(used), ("lane",))
        return Program(*(Turns(function, lanes, group, mesh) for function in program))
    if layout == "auto":
        layout = "map" if used[0].platform == "cpu" else "vmap"
    mesh = Mesh(np.array(used), ("lane",))
    lane, shared = PartitionSpec("lane"), PartitionSpec()
    padded = np.minimum(np.arange(lanes + -lanes % len(used)), lanes - 1)

    def pad(tree: Any) -> Any:
        check_lanes(tree, lanes)
        return jax.tree.map(lambda x: x[padded], tree)

    def sharded(batched: Callable[..., Any], in_specs: Any, out_specs: Any) -> Callable[..., Any]:
        return jax.shard_map(batched, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)

    def over_lanes(function: Callable[..., Any], in_specs: Any, out_specs: Any) -> Callable[..., Any]:
        batched = (_vmap if layout == "vmap" else _map)(function, in_specs, out_specs)
        return sharded(batched, in_specs, out_specs)

    def init_lanes(keys: Key[Array, "L"], targets: Any, hparams: HParams) -> TrainState:
        if layout == "vmap":
            return jax.vmap(trainer.init)(keys, targets, hparams)
        return jax.lax.map(lambda one: trainer.init(*one), (keys, targets, hparams))

    init = sharded(init_lanes, (lane, lane, lane), lane)
    warmup = over_lanes(trainer.warmup, (lane, shared, lane), (lane, shared))
    chunk = over_lanes(trainer.chunk, (lane, shared, lane), (lane, shared, lane))

    # What runs once is better compiled sooner than made faster.  XLA's simpler emitters for the CPU take 10 to 40 % less time.
    on_cpu = used[0].platform == "cpu"
    simpler = {"xla_cpu_use_fusion_emitters": False} if on_cpu else {}
    unoptimised = {"xla_backend_optimization_level": 0} if on_cpu else {}

    @partial(jax.jit, compiler_options=unoptimised | simpler)
    def init_all(keys: Key[Array, "L"], targets: Any, hparams: HParams) -> TrainState:
        return init(pad(keys), pad(targets), pad(hparams))

    @partial(jax.jit, donate_argnums=0, compiler_options=simpler)
    def warmup_all(states: TrainState, clock: Clock, hparams: HParams) -> tuple[TrainState, Clock]:
        return warmup(states, clock, pad(hparams))

    @partial(jax.jit, donate_argnums=0)
    def chunk_all(states: TrainState, clock: Clock, hparams: HParams) -> tuple[TrainState, Clock, LaneMetrics]:
        return chunk(states, clock, pad(hparams))

    return Program(init_all, warmup_all, chunk_all)


def lane_struct(trainer: Trainer) -> TrainState:
    """The shapes and dtypes of one lane's state."""
    hparams = jax.tree.map(np.float32, HParams())
    key = jax.eval_shape(lambda: jax.random.key(0))
    state: TrainState = jax.eval_shape(trainer.init, key, task_struct(trainer.space), hparams)
    return state


def lane_bytes(trainer: Trainer) -> int:
    """The size of one lane's state, most of it the replay."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(lane_struct(trainer)))


def room(trainer: Trainer, memory: int) -> int:
    """Lanes for which `memory` bytes of a device suffice: each with its state, and as much again for what a step computes."""
    return max(memory // (2 * lane_bytes(trainer)), 1)


def _spread(devices: Sequence[jax.Device], lanes: int) -> list[jax.Device]:
    """As many devices as there are lanes, if there are so many, taken from the processes by turns."""
    by_process: dict[int, list[jax.Device]] = {}
    for device in devices:
        by_process.setdefault(device.process_index, []).append(device)
    if lanes < len(by_process):
        raise ValueError(f"{len(by_process)} processes need at least a lane each (a seed, or a value of a sweep), got {lanes}")
    turns = chain.from_iterable(zip_longest(*by_process.values()))
    chosen = set(islice((device for device in turns if device is not None), lanes))
    return [device for device in devices if device in chosen]


def _axes(specs: Any) -> Any:
    """`vmap` axes of partition specs: 0 for what has lanes, None for what is shared."""
    return jax.tree.map(
        lambda spec: 0 if spec == PartitionSpec("lane") else None, specs, is_leaf=lambda x: isinstance(x, PartitionSpec)
    )


def _vmap(function: Callable[..., Any], in_specs: Any, out_specs: Any) -> Callable[..., Any]:
    return jax.vmap(function, in_axes=_axes(in_specs), out_axes=_axes(out_specs))


def _map(function: Callable[..., Any], in_specs: Any, out_specs: Any) -> Callable[..., Any]:
    """Like `_vmap`, one lane after another, for functions whose first argument and first result are the states.

    A lane is taken out of the others' states and put back in its place, so that there is room for one besides; it is no batch,
    and computes what it computes alone.
    """
    lanes_in, lanes_out = ([axis == 0 for axis in _axes(specs)] for specs in (in_specs, out_specs))

    def mapped(states: TrainState, *rest: Any) -> Any:
        def turn(data: Any, index: Int[Array, ""]) -> tuple[Any, list[Any]]:
            """All states after lane `index` had its turn, and what else that yielded."""

            def pick(tree: Any) -> Any:
                return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, index, keepdims=False), tree)

            own = [pick(arg) if of_lanes else arg for of_lanes, arg in zip(lanes_in[1:], rest, strict=True)]
            new, *yielded = function(_with_keys(pick(data), states), *own)
            put = jax.lax.dynamic_update_index_in_dim
            return jax.tree.map(lambda old, x: put(old, x, index, 0), data, _as_data(new)), yielded

        lanes = jnp.arange(jax.tree.leaves(states)[0].shape[0], dtype=jnp.int32)
        data, yielded = jax.lax.scan(turn, _as_data(states), lanes)
        # What is shared came out once per lane, all alike.
        results = (
            value if of_lanes else jax.tree.map(lambda x: x[0], value)
            for of_lanes, value in zip(lanes_out[1:], yielded, strict=True)
        )
        return _with_keys(data, states), *results

    return mapped


def _is_key(x: Array) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _as_data(tree: Any) -> Any:
    """Keys as numbers: checks against a key's second use cannot tell the keys of one array apart."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)


def _with_keys(data: Any, like: Any) -> Any:
    """`_as_data` undone, for a tree whose keys are where those of `like` are."""
    return jax.tree.map(
        lambda x, key: jax.random.wrap_key_data(x, impl=jax.random.key_impl(key)) if _is_key(key) else x, data, like
    )
