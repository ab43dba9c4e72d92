"""How well V2 foretells the return of tasks that nobody has played: `python -m experiments.foresight --run-dir DIR`.

Training goes on from the run's latest checkpoint, one evaluation period after another, and nothing is saved.  V2, as it is at
the start of a period, is asked about the tasks that training then makes and plays.  Policies frozen at the start of the period
play others of the same generator: one that goes on learning gets out of loops in which a frozen one stays to the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Bool, Float, Int, Key

from apt_jax import evaluation, learner
from apt_jax.config import HParams
from apt_jax.curricula.apt_gen_objectives import make_objectives, pessimistic
from apt_jax.curricula.base import GENERATED
from apt_jax.lanes import Program, make_program
from apt_jax.networks import QNetwork
from apt_jax.replay import Episode, Replay
from apt_jax.specs import Obs
from apt_jax.trainer import Clock, Trainer, TrainState
from experiments import markdown, runtime, settings
from experiments.errors import UsageError, exit_with
from experiments.problem import check_apt_gen, make_problem
from experiments.runner import load_lanes

HEADER = (
    "lane",
    "tasks played",
    "V2",
    "mean of its networks",
    "return in training",
    "of the averaged policy, frozen",
    "of the online policy, frozen",
)


@dataclass(frozen=True)
class Args:
    """Print what V2 expects of fresh tasks, as the generator sees it, and what they return.

    Attributes:
      run_dir: a run of APT-Gen.
      periods: evaluation periods to go on for.
      tasks: that the frozen policies play per period.
      seed: random seed of those tasks and of the policies' exploration.
    """

    run_dir: Path
    periods: int = 10
    tasks: int = 128
    seed: int = 0


class Foresight(NamedTuple):
    """Of the fresh tasks of one period, by lane: leaves [L].

    Attributes:
      played: tasks that training played, from beginning to end of the episode.
      value: V2 of those as the generator sees it: the mean of its networks less their spread.
      mean: V2 without that subtraction.
      training: what they returned.
      averaged: what others returned, proposed at the start, when the averaged policy played them, exploring as training does.
      online: the same of the online policy.
    """

    played: Float[Array, "L"]
    value: Float[Array, "L"]
    mean: Float[Array, "L"]
    training: Float[Array, "L"]
    averaged: Float[Array, "L"]
    online: Float[Array, "L"]


def main() -> int:
    """The command line."""
    args = tyro.cli(Args, prog="python -m experiments.foresight", description=__doc__)
    runtime.setup()
    settings.check_seed(args.seed)
    for name in ("periods", "tasks"):
        if getattr(args, name) < 1:
            raise UsageError(f"--{name} must be at least 1, got {getattr(args, name)}")
    experiment = settings.load(args.run_dir)
    trainer = make_problem(experiment).trainer
    check_apt_gen(trainer, args.run_dir)
    states, clock, hparams = jax.device_put(load_lanes(args.run_dir, experiment, trainer), jax.local_devices()[0])
    names = [lane.name for lane in experiment.lanes]
    print(f"{args.run_dir} after {int(clock.env_steps):,} steps; {args.periods} periods of {trainer.config.eval_every:,}\n")
    periods = []
    for key in jax.random.split(jax.random.key(args.seed), args.periods):
        states, clock, seen = period(trainer, states, clock, hparams, args.tasks, key)
        periods.append(seen)
    print(table(names, jax.tree.map(lambda *leaves: np.stack(leaves), *periods)))
    return 0


def period(
    trainer: Trainer, states: TrainState, clock: Clock, hparams: HParams, tasks: int, key: Key[Array, ""]
) -> tuple[TrainState, Clock, Foresight]:
    """Trains every lane (leaves [L, ...]) for one period more; consumes `key`, and `states` are donated."""
    program, frozen, ahead = _compiled(trainer, len(states.key))
    ensembles = jax.tree.map(jnp.copy, states.curriculum.models.return_value)
    averaged, online = frozen(states, key, tasks, hparams)
    states, after, _ = program.chunk(states, clock, hparams)
    played, value, mean, training = ahead(ensembles, states.replay, clock, after, hparams)
    seen = Foresight(played, value, mean, training, averaged, online)
    return states, after, jax.tree.map(np.asarray, seen)


def played_within(episodes: Episode, start: Int[Array, ""], end: Int[Array, ""], horizon: int) -> Bool[Array, "n"]:
    """Which episodes began at iteration `start` or later, and early enough for the longest to be over before `end`."""
    began = episodes.end - episodes.length + 1
    return (began >= start) & (began <= end - horizon)


@cache
def _compiled(trainer: Trainer, lanes: int) -> tuple[Program, Callable[..., Any], Callable[..., Any]]:
    space = trainer.space
    network = QNetwork(space.obs_spec, space.num_actions)
    objectives = make_objectives(space, trainer.config)

    def frozen(state: TrainState, key: Key[Array, ""], tasks: int, hparams: HParams) -> tuple[Float[Array, ""], ...]:
        key_propose, key_play = jax.random.split(key)
        proposed = jax.vmap(space.instantiate)(trainer.propose(state, key_propose, tasks, hparams))

        def mean_return(params: Any) -> Float[Array, ""]:
            def act(obs: Obs, key: Key[Array, ""]) -> Int[Array, "n"]:
                return learner.epsilon_greedy(network, params, obs, key, hparams.epsilon_end)

            return jnp.mean(evaluation.play(space, proposed, act, key_play)[0].episode_return)

        return mean_return(state.learner.target_params), mean_return(state.learner.params)

    def ahead(ensemble: Any, replay: Replay, before: Clock, after: Clock, hparams: HParams) -> tuple[Float[Array, ""], ...]:
        episodes = jax.tree.map(lambda ring: ring[GENERATED], replay.episodes)
        fresh = played_within(episodes, before.iteration, after.iteration, space.horizon)
        values = objectives.evaluate(ensemble, episodes.w)
        outcomes = (pessimistic(values, hparams.pessimism), jnp.mean(values, axis=0), episodes.episode_return)
        return (jnp.sum(fresh, dtype=jnp.float32), *(jnp.mean(x, where=fresh) for x in outcomes))

    return (
        make_program(trainer, lanes, devices=jax.devices()[:1]),
        jax.jit(jax.vmap(frozen, (0, None, None, 0)), static_argnums=2),
        jax.jit(jax.vmap(ahead, (0, 0, None, None, 0))),
    )


def table(names: list[str], periods: Foresight) -> str:
    """A line per lane, over all periods (leaves [P, L])."""
    rows = []
    for lane, name in enumerate(names):
        of_lane = Foresight(*(values[:, lane] for values in periods))
        # A period without a fresh task has no mean.
        totals = (np.sum(np.where(of_lane.played > 0, x * of_lane.played, 0.0)) for x in of_lane[1:4])
        over_tasks = (total / max(of_lane.played.sum(), 1.0) if of_lane.played.any() else np.nan for total in totals)
        values = (*over_tasks, of_lane.averaged.mean(), of_lane.online.mean())
        rows.append((name, f"{of_lane.played.sum():.0f}", *(f"{value:.2f}" for value in values)))
    return markdown.table(HEADER, rows)


if __name__ == "__main__":
    exit_with(main)
