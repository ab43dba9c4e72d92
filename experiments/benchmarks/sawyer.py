"""How well the Sawyer arm's pushes agree with the task space's: `python -m experiments.benchmarks.sawyer`."""

from __future__ import annotations

import collections
import dataclasses
import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from envs.manipulation.push import push
from envs.manipulation.sawyer.replay import replay
from experiments.benchmarks import _measure
from experiments.benchmarks._measure import Options
from experiments.benchmarks.manipulation import random_pushes
from experiments.errors import exit_with


@dataclass(frozen=True)
class Args(Options):
    """Play random pushes on uniformly random tables with the arm.

    Attributes:
      pushes: how many.
    """

    pushes: int = 200


@dataclass(frozen=True)
class Agreement:
    """How the pushes of both ended.

    Attributes:
      events: by the task space's event and the arm's, how many pushes.
      agree: share of the pushes with the same event.
      distances: metres between the can's places, for each push that both end without an event.
      tracking: metres that the tip was off its course in any stroke, at most.
      seconds: per push.
    """

    events: dict[str, int]
    agree: float
    distances: list[float]
    tracking: float
    seconds: float


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.sawyer")
    _measure.check(args)
    if args.quick:
        args = dataclasses.replace(args, pushes=2)
    result = measure(args.pushes)
    header = ["pushes", "same event", "mean distance, mm", "largest, mm", "tracking, mm", "s per push"]
    distances = 1000 * np.array(result.distances or [np.nan])
    values = [100 * result.agree, distances.mean(), distances.max(), 1000 * result.tracking, result.seconds]
    row = [str(args.pushes), *(_measure.number(float(value)) for value in values)]
    row[1] += " %"
    _measure.report("sawyer", args, dataclasses.asdict(result), _measure.table(header, [row]))
    return 0


def measure(pushes: int) -> Agreement:
    """Random pushes of the first can, by the task space and by the arm."""
    tasks, states, directions = random_pushes(jax.random.key(0), pushes)

    @jax.jit
    @jax.vmap
    def simulate(task, state, direction):  # type: ignore[no-untyped-def]
        return push(task, state.cans, task.present, can=jnp.int32(0), direction=direction)

    tasks, states, directions, outcome = jax.device_get((tasks, states, directions, simulate(tasks, states, directions)))
    ours = np.select([outcome.fell, outcome.hit], ["fell", "hit"], "")
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], tasks) for i in range(pushes)]
    began = time.perf_counter()
    played = [replay(each[i], states.goal[i], [directions[i]])[0] for i in range(pushes)]
    seconds = (time.perf_counter() - began) / pushes
    theirs = np.array([one.event for one in played])
    away = np.linalg.norm(np.array([one.cans[0] for one in played]) - outcome.position, axis=-1)
    pairs = collections.Counter(f"{a or 'none'}, {b or 'none'}" for a, b in zip(ours.tolist(), theirs.tolist(), strict=True))
    return Agreement(
        events=dict(pairs),
        agree=float((ours == theirs).mean()),
        distances=away[(ours == "") & (theirs == "")].tolist(),
        tracking=max(one.tracking for one in played),
        seconds=seconds,
    )


if __name__ == "__main__":
    exit_with(main)
