"""What a push costs: `python -m experiments.benchmarks.manipulation`.

Random pushes on uniformly random tables, side by side in one compiled program, against MuJoCo itself: the same model, and
the true shapes of everything on the table.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float, Key

import envs
from envs.manipulation import scene
from envs.manipulation.push import STEPS, TOOL_START, possible, stroke
from envs.manipulation.table import DIRECTIONS, Task
from experiments.benchmarks import _measure, _true_shapes
from experiments.benchmarks._measure import Options, Timing
from experiments.errors import exit_with


@dataclass(frozen=True)
class Args(Options):
    """Time pushes, alone and side by side.

    Attributes:
      space: the one with the arm takes it in MJX; in MuJoCo the tool pushes by itself.
      envs: numbers of environments side by side.
      cores: cores that the process may use.
      at_least: seconds that one measurement takes at least.
      checked: random pushes that are looked through for what is not a number.
      true_pushes: pushes with true shapes that are timed.
    """

    space: Literal["manipulation", "manipulation_sawyer"] = "manipulation"
    envs: tuple[int, ...] = (1, 16, 64, 256)
    cores: int = 1
    at_least: float = 2.0
    checked: int = 10_000
    true_pushes: int = 50


@dataclass(frozen=True)
class Side:
    """Environments side by side: the time of one push of all of them, and the largest resident size of its process, in bytes,
    compilation included.
    """

    timing: Timing
    peak_memory: int


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.manipulation")
    _measure.check(args)
    _measure.pin(args.cores)
    if args.quick:
        args = dataclasses.replace(args, repeats=1, envs=args.envs[:2], at_least=0.0, checked=64, true_pushes=2)
    # Each in a process of its own, for its memory; without compilation cache, because the seconds to compile are results too.
    sides = {n: _measure.in_new_process(time_pushes, n, args) for n in args.envs}
    jax.config.update("jax_num_cpu_devices", 1)
    same, true = time_same_model(args), time_true_shapes(args)
    faults = count_faults(args.space, args.checked)
    rows = [
        [f"MJX, {n} side by side", side.timing.rate(n), *_costs(side.timing, n), f"{side.peak_memory / 2**20:,.0f}"]
        for n, side in sides.items()
    ]
    rows.append(["MuJoCo, same model", same.rate(), *_costs(same, 1), ""])
    rows.append(["MuJoCo, true shapes", true.rate(), *_costs(true, 1), ""])
    header = ["pushes", "per second", "minutes per 100,000", "compile, s", "peak memory, MiB"]
    text = f"{_measure.table(header, rows)}\n{faults} of {args.checked:,} random pushes gave what is not a number.\n"
    results = {"side_by_side": sides, "same_model": same, "true_shapes": true, "faults": faults}
    _measure.report(args.space, args, results, text)
    return int(faults > 0)


def random_pushes(key: Key[Array, ""], n: int) -> tuple[Any, Any, Array]:
    """Uniformly random tasks, states and pushes of the first can, leaves [n, ...]; consumes `key`.

    In the task space itself a push rarely finds its can, so the first is made to appear.  It is pushed in a direction that has
    room for the tool behind it; were there none, nothing would move.
    """
    space = envs.make("manipulation")
    key_w, key_reset, key_action = jax.random.split(key, 3)
    w = jax.vmap(space.sample_uniform)(jax.random.split(key_w, n))
    first = w["placement"][:, 0]
    flat = jax.nn.one_hot(jnp.argmax(first, axis=-1), first.shape[-1]).reshape(w["blocks"].shape[:-1])
    tasks = jax.vmap(space.instantiate)({**w, "blocks": w["blocks"].at[..., 0].add(flat)})
    states, _ = jax.vmap(space.reset)(jax.random.split(key_reset, n), tasks)

    def has_room(task: Task, cans: Float[Array, "3 2"]) -> Bool[Array, "4"]:
        one = partial(possible, task, cans, task.present, can=jnp.int32(0))
        return jax.vmap(lambda direction: one(direction=direction))(jnp.arange(len(DIRECTIONS)))

    logits = jnp.where(jax.vmap(has_room)(tasks, states.cans), 0.0, -100.0)
    return tasks, states, jax.random.categorical(key_action, logits)


def time_pushes(n: int, args: Args) -> Side:
    """Environments that start a new random task with every push, so that none is over before the others begin."""
    jax.config.update("jax_num_cpu_devices", 1)
    step = jax.vmap(envs.make(args.space).step)

    def push(carry: tuple[Key[Array, ""], Float[Array, ""]], _: None) -> tuple[Key[Array, ""], Float[Array, ""]]:
        key, key_push = jax.random.split(carry[0])
        tasks, states, action = random_pushes(key_push, n)
        return key, carry[1] + jnp.sum(step(states, action, tasks).reward)

    carry = (jax.random.key(0), jnp.float32(0))
    timing = _measure.time_loop(push, carry, None, repeats=args.repeats, at_least=args.at_least)
    return Side(timing, _measure.peak_memory())


def same_model() -> tuple[mujoco.MjModel, mujoco.MjData, Float[np.ndarray, "state"], Float[np.ndarray, "steps 1"]]:
    """The scene of a push, on ground everywhere, with a strong servo on its tool; the start of a push, the servo's course."""
    xml = scene.push_xml().replace("</mujoco>", '<actuator><position joint="tool" kp="2e6" kv="4e4"/></actuator></mujoco>')
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[7] = TOOL_START
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    places = np.asarray(jax.vmap(stroke)(jnp.arange(STEPS) * scene.TIMESTEP)[0])
    return model, data, state, (TOOL_START + places)[:, None].astype(float)


def time_same_model(args: Args) -> Timing:
    """Pushes of `same_model` by `mujoco.rollout`."""
    model, data, state, control = same_model()
    pushes = 2 if args.quick else 200

    def run() -> float:
        began = time.perf_counter()
        mujoco.rollout.rollout(model, data, np.tile(state, (pushes, 1)), np.tile(control, (pushes, 1, 1)))
        return (time.perf_counter() - began) / pushes

    run()
    return Timing(tuple(run() for _ in range(args.repeats)), 0.0)


def time_true_shapes(args: Args) -> Timing:
    """Cylinders, boxes and all blocks of random tables, each pushed once for as long as a push of ours lasts."""
    tasks, _, directions = jax.device_get(random_pushes(jax.random.key(0), args.true_pushes))
    scenes = [
        _true_shapes.push_scene(jax.tree.map(lambda leaf, i=i: leaf[i], tasks), 0, int(directions[i]))
        for i in range(args.true_pushes)
    ]

    def run() -> float:
        began = time.perf_counter()
        for model in scenes:
            for _ in _true_shapes.stroke(model, mujoco.MjData(model), STEPS * scene.TIMESTEP):
                pass
        return (time.perf_counter() - began) / args.true_pushes

    return Timing(tuple(run() for _ in range(args.repeats)), 0.0)


def count_faults(space: str, pushes: int) -> int:
    """Random pushes after which a place, a reward or a height is not a number."""
    batch = min(pushes, 250)
    step = jax.vmap(envs.make(space).step)

    @jax.jit
    def faults(key: Key[Array, ""]) -> Array:
        tasks, states, action = random_pushes(key, batch)
        out = step(states, action, tasks)
        leaves = jax.tree.leaves((out.state.cans, out.obs, out.reward))
        return jnp.sum(~jnp.all(jnp.stack([jnp.isfinite(x).reshape(batch, -1).all(axis=1) for x in leaves]), axis=0))

    return sum(int(faults(jax.random.key(1 + i))) for i in range(-(-pushes // batch)))


def _costs(timing: Timing, n: int) -> tuple[str, str]:
    return _measure.number(timing.median / n * 100_000 / 60), f"{timing.compile_seconds:.1f}"


if __name__ == "__main__":
    exit_with(main)
