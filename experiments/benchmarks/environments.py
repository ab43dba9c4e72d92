"""Environment steps per second beside other grid worlds: `python -m experiments.benchmarks.environments`.

Uniformly random actions, no agent, no replay; where an episode ends, a fresh random task begins.  The others are the extra
`peers` (`pip install -c constraints.txt -e '.[peers]'`); one that is missing is left out.  Common to all: a 10 x 10 board,
keys and doors, a 7 x 7 view that sees through walls, episodes of at most 50 steps, one process on the same cores.  A step is
the move, its reward, whether the episode ended, the observation, and the reset where it did.  What differs:

* Grid-World draws 64 tiles and 5 objects for a task (the paper's parameter w, then M(w)); it observes the view and the places
  of the agent and of the objects.  4 actions.  A third of the tiles is lava, so that episodes are short.
* xminigrid and navix play DoorKey, which has no lava; they draw the places of a wall, a door, a key and the agent, and navix
  that of the goal.  They observe the view as kind and colour (xminigrid) or kind, colour and state (navix) of each tile.  6 and
  7 actions.
* MiniGrid plays DoorKey, and boards drawn as Grid-World draws them, by Gymnasium's `SyncVectorEnv` (`AsyncVectorEnv` starts a
  process for each environment); it observes kind, colour and state of each tile.  7 actions.  A reset takes a step of its own.

Environments in JAX are steps of a compiled loop that draws the actions too.  All are reset by the same code (`restart`) instead
of what comes with them, which under `vmap` draws a task for every environment at every step and throws nearly all away.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Int, Key

from envs.grid_world.dynamics import HORIZON
from experiments.benchmarks import _measure
from experiments.benchmarks._grid_worlds import WORLDS, JaxWorld, restart
from experiments.benchmarks._measure import Options, Timing
from experiments.errors import exit_with

PEERS = ("xminigrid", "navix", "minigrid", "gymnasium")

GROUPS = 8
"""Share of a batch that is reset at once: more than the share of our environments that are done after a step, 1 in 13."""

COUNTED = 64
"""Environments whose episodes are counted, apart from what is timed."""


@dataclass(frozen=True)
class Args(Options):
    """Time random walks in grid worlds.

    Attributes:
      batches: numbers of environments side by side.
      cores: cores that the process may use.
      at_least: seconds that one measurement takes at least.
    """

    batches: tuple[int, ...] = (1, 64, 1_024, 8_192)
    cores: int = 1
    at_least: float = 1.0


@dataclass(frozen=True)
class Walk:
    """Random walks in one kind of environment.

    Attributes:
      step: time of one step of all environments side by side, by their number.
      episode_length: mean number of steps of an episode.
    """

    step: dict[int, Timing]
    episode_length: float


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.environments")
    _measure.check(args)
    _measure.pin(args.cores)
    # No compilation cache: the seconds to compile are results too.
    jax.config.update("jax_num_cpu_devices", 1)
    if args.quick:
        args = dataclasses.replace(args, batches=args.batches[:2], repeats=2, at_least=0.0)
    walks: dict[str, Walk] = {}
    for name, make in WORLDS.items():
        try:
            world = make()
        except ImportError as error:
            print(f"left out: {name} ({error})")
            continue
        walks[name] = walk(world, args) if isinstance(world, JaxWorld) else walk_in_python(world, args)
    _measure.report("environments", args, {"walks": walks}, tables(walks, args.batches), peers=PEERS)
    return 0


Carry: TypeAlias = tuple[Key[Array, ""], Any, Int[Array, ""]]
"""Key, environments and the episodes that ended."""


def walk(world: JaxWorld, args: Args) -> Walk:
    """Random walks as compiled loops, one for each number of environments."""

    def begin(n: int) -> tuple[Carry, Callable[[Carry, None], Carry]]:
        def advance(carry: Carry, _: None) -> Carry:
            key, states, episodes = carry
            key, key_action, key_start = jax.random.split(key, 3)
            states = jax.vmap(world.step)(states, jax.random.randint(key_action, (n,), 0, world.num_actions))
            states, done = restart(world, states, key_start, max(n // GROUPS, 1))
            return key, states, episodes + jnp.sum(done, dtype=jnp.int32)

        states = jax.jit(jax.vmap(world.start))(jax.random.split(jax.random.key(0), n))
        return (jax.random.key(1), states, jnp.int32(0)), advance

    def time_steps(n: int) -> Timing:
        carry, advance = begin(n)
        return _measure.time_loop(advance, carry, None, repeats=args.repeats, at_least=args.at_least)

    carry, advance = begin(COUNTED)
    counted = jax.jit(lambda carry: jax.lax.fori_loop(0, 20 * HORIZON, lambda _, c: advance(c, None), carry))(carry)
    return Walk({n: time_steps(n) for n in args.batches}, COUNTED * 20 * HORIZON / int(counted[2]))


def walk_in_python(make: Callable[[int], Any], args: Args) -> Walk:
    """Random walks in Gymnasium's vector environments."""

    def begin(n: int) -> tuple[Any, Callable[[], int]]:
        env = make(n)
        env.reset(seed=0)
        rng = np.random.default_rng(0)

        def advance() -> int:
            _, _, terminated, truncated, _ = env.step(rng.integers(env.single_action_space.n, size=n))
            return int(np.sum(terminated | truncated))

        return env, advance

    def time_steps(n: int) -> Timing:
        env, advance = begin(n)

        def run() -> float:
            began, steps, seconds = time.perf_counter(), 0, 0.0
            while steps == 0 or seconds < args.at_least:
                advance()
                steps, seconds = steps + 1, time.perf_counter() - began
            return seconds / steps

        run()
        timing = Timing(tuple(run() for _ in range(args.repeats)), 0.0)
        env.close()
        return timing

    env, advance = begin(COUNTED)
    episodes = sum(advance() for _ in range(20 * HORIZON))
    env.close()
    return Walk({n: time_steps(n) for n in args.batches}, COUNTED * 20 * HORIZON / episodes)


def tables(walks: Mapping[str, Walk], batches: Sequence[int]) -> str:
    """Steps per second, what ours are to the others', and what else is worth knowing."""
    columns = [f"{n:,} side by side" for n in batches]
    rates = _measure.table(
        ["steps per second", *columns], [[name, *(walk.step[n].rate(n) for n in batches)] for name, walk in walks.items()]
    )
    (_, ours), *others = walks.items()
    ratios = _measure.table(
        ["ours against", *columns],
        [[name, *(_measure.number(walk.step[n].median / ours.step[n].median) for n in batches)] for name, walk in others],
    )
    rest = _measure.table(
        ["", "steps per episode", *(f"compile {n:,}, s" for n in batches)],
        [
            [name, _measure.number(walk.episode_length), *(f"{walk.step[n].compile_seconds:.1f}" for n in batches)]
            for name, walk in walks.items()
        ],
    )
    return "\n".join((rates, ratios, rest))


if __name__ == "__main__":
    exit_with(main)
