"""How well the task space's pushes agree with the truth: `python -m experiments.benchmarks.sawyer`.

Random pushes by the tool in MJX, beside the same ones in MuJoCo with the true shapes of everything on the table, by the tool
and by the Sawyer arm, and by the arm in MJX.
"""

from __future__ import annotations

import collections
import dataclasses
import time
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, Int, Shaped

from envs.manipulation.arms import arm
from envs.manipulation.dynamics import State
from envs.manipulation.push import Outcome, push
from envs.manipulation.sawyer.replay import replay
from envs.manipulation.table import Task
from experiments.benchmarks import _measure, _true_shapes
from experiments.benchmarks._measure import Options
from experiments.benchmarks.manipulation import random_pushes
from experiments.errors import exit_with


@dataclass(frozen=True)
class Args(Options):
    """Random pushes on uniformly random tables, by the tool and by the arm; each once, whatever `repeats` says.

    Attributes:
      pushes: how many.
    """

    pushes: int = 200


@dataclass(frozen=True)
class Agreement:
    """How pushes ended beside the tool's in MJX.

    Attributes:
      events: by the tool's event and theirs, how many pushes.
      agree: share of the pushes with the same event.
      distances: metres between the can's places, for each push that both end without an event.
      seconds: per push.
      tracking: metres that the tip was off its course in any stroke, at most; None if not looked at.
    """

    events: dict[str, int]
    agree: float
    distances: list[float]
    seconds: float
    tracking: float | None


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.benchmarks.sawyer")
    _measure.check(args)
    args = dataclasses.replace(args, repeats=1, pushes=2 if args.quick else args.pushes)
    results = measure(args.pushes)
    header = ["pushes", "same event", "mean distance, mm", "largest, mm", "tracking, mm", "s per push"]
    text = _measure.table(header, [_row(name, result) for name, result in results.items()])
    _measure.report("sawyer", args, {name: dataclasses.asdict(result) for name, result in results.items()}, text)
    return 0


def measure(pushes: int) -> dict[str, Agreement]:
    """Random pushes of the first can: how those of the others agree with the tool's in MJX."""
    tasks, states, directions = jax.device_get(random_pushes(jax.random.key(0), pushes))

    def simulate(name: str) -> tuple[Outcome, float]:
        """What the pushes of an arm in MJX did, and seconds per push."""

        def one(task: Task, state: State, direction: Int[Array, ""]) -> Outcome:
            return push(task, state.cans, task.present, can=jnp.int32(0), direction=direction, arm=arm(name))

        run = jax.jit(jax.vmap(one)).lower(tasks, states, directions).compile()
        began = time.perf_counter()
        outcome: Outcome = jax.device_get(run(tasks, states, directions))
        return outcome, (time.perf_counter() - began) / pushes

    tool, _ = simulate("tool")
    inside, inside_seconds = simulate("sawyer")
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], tasks) for i in range(pushes)]
    began = time.perf_counter()
    true = [_true_shapes.push(each[i], 0, int(directions[i])) for i in range(pushes)]
    true_seconds = (time.perf_counter() - began) / pushes
    began = time.perf_counter()
    played = [replay(each[i], states.goal[i], [directions[i]])[0] for i in range(pushes)]
    seconds = (time.perf_counter() - began) / pushes
    events, places = np.array([one.event for one in played]), np.array([one.cans[0] for one in played])
    tracking = max(one.tracking for one in played)
    return {
        "the tool in MuJoCo, true shapes": _agreement(
            tool, np.array([event for _, event in true]), np.array([place for place, _ in true]), true_seconds, None
        ),
        "the arm in MuJoCo, true shapes": _agreement(tool, events, places, seconds, tracking),
        "the arm in MJX": _agreement(tool, _events(inside), np.asarray(inside.position), inside_seconds, None),
    }


def _events(outcome: Outcome) -> Shaped[np.ndarray, "n"]:
    return np.select([outcome.fell, outcome.hit], ["fell", "hit"], "")


def _agreement(
    tool: Outcome, events: Shaped[np.ndarray, "n"], places: Float[np.ndarray, "n 2"], seconds: float, tracking: float | None
) -> Agreement:
    ours = _events(tool)
    away = np.linalg.norm(places - tool.position, axis=-1)
    pairs = collections.Counter(f"{a or 'none'}, {b or 'none'}" for a, b in zip(ours.tolist(), events.tolist(), strict=True))
    return Agreement(
        events=dict(pairs),
        agree=float((ours == events).mean()),
        distances=away[(ours == "") & (events == "")].tolist(),
        seconds=seconds,
        tracking=tracking,
    )


def _row(name: str, result: Agreement) -> list[str]:
    distances = 1000 * np.array(result.distances or [np.nan])
    away = [_measure.number(float(value)) for value in (distances.mean(), distances.max())]
    tracking = "" if result.tracking is None else _measure.number(1000 * result.tracking)
    pushes, same = sum(result.events.values()), f"{_measure.number(100 * result.agree)} %"
    return [f"{pushes} by {name}", same, *away, tracking, _measure.number(result.seconds)]


if __name__ == "__main__":
    exit_with(main)
