"""What the compiler made of a chunk: rings written in place, every buffer of the state reused, nothing for the host to do.

That nothing is compiled after the first chunk is in `test_trainer`.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax.config import Config, HParams
from apt_jax.lanes import make_program, stack_hparams, stack_targets
from apt_jax.specs import Vector
from apt_jax.trainer import Clock, make_trainer
from experiments.examples.corridor import LENGTH, Corridor

COLUMNS = 1_000_003
"""A prime: an array whose size it divides is a ring of transitions, or a copy of one."""

CONFIG = Config(
    method="apt_gen",
    envs_per_source=2,
    warmup_steps=100,
    updates_per_step=1,
    batch_size=4,
    success_share=0.5,
    n_step=2,
    replay_steps=2 * COLUMNS,
    replay_episodes=64,
    model_updates_per_step=0.5,
    model_batch_size=4,
    recent_steps=100,
    refresh_every=20,
    eval_every=40,
    eval_episodes=2,
    probe_tasks=2,
    return_window=5,
)

IN_PLACE = {"parameter", "get-tuple-element", "bitcast", "dynamic-update-slice"}
"""Operations that may yield a ring within the loop: those that move nothing, and a write to a part of one."""

CALLS = {"while", "fusion", "call", "conditional"}
"""Operations whose result is made by computations, which are looked at themselves."""

HOST = {"infeed", "outfeed", "send", "recv"}


PAIR = {"place": Vector(2, -LENGTH, LENGTH, "int8")}


class PairedCorridor(Corridor):
    """Observes two numbers at once: the CPU's compiler copies an array with an axis of size 1, though only outside the loop."""

    obs_spec = PAIR

    def _observe(self, position, goal):
        return {"place": jnp.stack([position, goal - position]).astype(jnp.int8)}


class Operation(NamedTuple):
    """One line of a compiled program; `size` is the number of elements of its result, 0 if that is a tuple."""

    name: str
    size: int
    line: str


def operations(text: str) -> dict[str, list[Operation]]:
    """The operations of every computation of a compiled program, by its name."""
    computations: dict[str, list[Operation]] = {}
    current: list[Operation] = []
    for line in text.splitlines():
        if start := re.match(r"(?:ENTRY )?%([\w.-]+) \(.*\{$", line):
            current = computations.setdefault(start[1], [])
        elif found := re.match(r"\s+(?:ROOT )?%[\w.-]+ = (?:\(.*?\)|\w+\[([\d,]*)\]\S*) ([\w-]+)\(", line):
            shape, name = found.groups()
            current.append(Operation(name, 0 if shape is None else math.prod(map(int, filter(None, shape.split(",")))), line))
    return computations


def within_loops(text: str) -> list[Operation]:
    """Every operation that runs in a loop, those of the computations called there included."""
    computations = operations(text)
    todo = [name for group in computations.values() for op in group if op.name == "while" for name in _called(op)]
    seen: set[str] = set()
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            todo += [called for op in computations[name] for called in _called(op)]
    return [op for name in sorted(seen) for op in computations[name]]


def _called(op: Operation) -> list[str]:
    single = re.findall(r"(?:body|condition|calls|to_apply|true_computation|false_computation)=%([\w.-]+)", op.line)
    branches = re.findall(r"branch_computations=\{(.*?)\}", op.line)
    return single + [name.strip(" %") for group in branches for name in group.split(",")]


def copies(text: str, columns: int) -> list[Operation]:
    """Operations in loops that make a ring anew."""
    rings = [op for op in within_loops(text) if op.size and op.size % columns == 0]
    assert rings, "no ring is used in a loop"
    return [op for op in rings if op.name not in IN_PLACE | CALLS]


def host_calls(text: str) -> list[Operation]:
    """Operations, anywhere, that need the host."""
    everything = [op for group in operations(text).values() for op in group]
    return [
        op for op in everything if op.name.removesuffix("-done") in HOST or (op.name == "custom-call" and "callback" in op.line)
    ]


@pytest.fixture(scope="module")
def states():
    """The shapes of two lanes, one on each device; nothing of this size is ever made."""
    return jax.eval_shape(program().init, *lanes())


@pytest.fixture(scope="module")
def chunk(states):
    return program().chunk.lower(states, jax.eval_shape(Clock.start), lanes()[-1]).compile()


@pytest.fixture(scope="module")
def text(chunk):
    return chunk.as_text()


def program(count=2, **options):
    return make_program(make_trainer(PairedCorridor(), CONFIG), count, **options)


def lanes(count=2):
    keys = jax.eval_shape(lambda: jax.vmap(jax.random.key)(np.arange(count)))
    return keys, stack_targets([np.int32(7)] * count), stack_hparams([HParams()] * count)


def test_no_ring_is_copied_in_the_loop(text):
    assert copies(text, COLUMNS) == []


def test_there_is_no_room_for_a_copy_of_a_ring(chunk, states):
    """Nor outside the loop: all that a device needs besides its state is less than the smallest ring."""
    rings = jax.tree.leaves(states.replay.transitions)
    assert chunk.memory_analysis().temp_size_in_bytes < min(ring.size * ring.dtype.itemsize // 2 for ring in rings)


def test_lanes_side_by_side_copy_no_ring(states):
    """Two on one device, as accelerators have them."""
    together = program(layout="vmap", devices=jax.devices()[:1])
    chunk = together.chunk.lower(states, jax.eval_shape(Clock.start), lanes()[-1]).compile()
    assert copies(chunk.as_text(), COLUMNS) == []
    ring = min(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(states.replay.transitions))
    assert chunk.memory_analysis().temp_size_in_bytes < ring


def test_lanes_that_take_turns_have_room_for_one_besides():
    """Three on one device: the one at work is taken out and put back."""
    turns = program(3, layout="map", devices=jax.devices()[:1])
    states = jax.eval_shape(turns.init, *lanes(3))
    memory = turns.chunk.lower(states, jax.eval_shape(Clock.start), lanes(3)[-1]).compile().memory_analysis()
    one = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(states.replay)) / 3
    assert memory.temp_size_in_bytes < 1.2 * one


def test_every_buffer_of_the_state_is_reused(text, states):
    aliases = re.findall(r"\{(\d+)\}: \((\d+), \{\}, m\w+-alias\)", text.partition("\n")[0])
    reused = {int(output): int(argument) for output, argument in aliases}
    assert reused == {leaf: leaf for leaf in range(len(jax.tree.leaves(states)))}


def test_a_chunk_never_needs_the_host(text):
    assert host_calls(text) == []


def write_column(ring, column):
    return jax.lax.dynamic_update_slice_in_dim(ring, jnp.full((2, 1), column, jnp.float32), column, axis=1)


def in_place(ring, column):
    ring = write_column(ring, column)
    return ring, ring[0, column // 2]


def read_first(ring, column):
    return write_column(ring, column), ring[0, column // 2]


def write_behind_a_mask(ring, column):
    ring = jnp.where(jnp.arange(ring.shape[1])[None] == column, 1.0, ring)
    return ring, ring[0, column // 2]


def ask_the_host(ring, column):
    ring = write_column(ring, column)
    return ring, jax.pure_callback(lambda x: x, jax.ShapeDtypeStruct((), jnp.float32), ring[0, column])


@pytest.mark.parametrize(
    ("step", "copied", "asks"),
    [
        (in_place, False, False),
        (read_first, True, False),
        (write_behind_a_mask, True, False),
        (ask_the_host, False, True),
    ],
)
def test_faults_are_found(step, copied, asks):
    def loop(ring):
        return jax.lax.scan(step, ring, jnp.arange(8, dtype=jnp.int32))

    text = jax.jit(loop, donate_argnums=0).lower(jax.ShapeDtypeStruct((2, 10_007), jnp.float32)).compile().as_text()
    assert bool(copies(text, 10_007)) == copied
    assert bool(host_calls(text)) == asks
