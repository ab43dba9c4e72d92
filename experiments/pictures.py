"""Every picture of a run directory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import envs
from apt_jax.specs import Params
from experiments import episodes, film, plots, run_dir
from experiments.problem import Problem
from experiments.settings import Experiment, target_name

_COLUMNS, _ROWS = 6, 5
"""Steps and lanes in the picture of the progression, at most."""

_SAMPLES, _SMALL = 30, 8
"""Steps, at most, and pixels per tile where all sampled tasks are shown together."""


def draw(path: Path, experiment: Experiment, problem: Problem, policies: Any) -> None:
    """Learning curves, progression of generated tasks, and the best lane's policy (leaves [L, ...]) on the target."""
    draw_curves(path, experiment)
    if run_dir.task_files(path):
        draw_progression(path / "progression.png", path, experiment, problem.space, problem.target, problem.space.render)
        draw_tasks(path, experiment, problem)
    draw_policy(path, experiment, problem, policies)


def draw_curves(path: Path, experiment: Experiment) -> None:
    """learning_curves.png."""
    delta = experiment.hparams.delta
    plots.learning_curves(
        path / "learning_curves.png",
        run_dir.read_settings(path),
        delta=None if isinstance(delta, tuple) else delta,
        title=f"{experiment.config.method} on {experiment.space}, target {target_name(experiment)}",
    )


def draw_progression(
    file: Path,
    path: Path,
    experiment: Experiment,
    space: envs.BenchmarkSpace,
    target: Any,
    picture: Callable[[Any], plots.Image],
) -> None:
    """The first sampled task of each lane of the run in `path` over time, and the target; `picture` draws a task."""
    files = run_dir.task_files(path)
    instantiate = jax.jit(space.instantiate)
    lanes = range(min(_ROWS, len(experiment.lanes)))
    boards = {}
    for step in plots.evenly(list(files), at_most=_COLUMNS):
        with np.load(files[step]) as w:
            boards[step] = [picture(instantiate({name: w[name][lane, 0] for name in w})) for lane in lanes]
    plots.progression(file, boards, picture(target), rows=[experiment.lanes[lane].name for lane in lanes])


def draw_tasks(path: Path, experiment: Experiment, problem: Problem) -> None:
    """tasks/*.png: the sampled tasks of each lane over time."""
    instantiate = jax.jit(problem.space.instantiate)
    samples = {}
    files = run_dir.task_files(path)
    for step in plots.evenly(list(files), at_most=_SAMPLES):
        with np.load(files[step]) as w:
            samples[step] = {name: w[name] for name in w}

    def picture(w: Params) -> plots.Image:
        return problem.space.render(instantiate(w), tile_size=_SMALL)

    for i, lane in enumerate(experiment.lanes):
        boards = {
            step: [picture({name: w[name][i, task] for name in w}) for task in range(next(iter(w.values())).shape[1])]
            for step, w in samples.items()
        }
        plots.mosaic(path / "tasks" / f"{lane.slug}.png", boards, title=f"generated tasks, {lane.name}")


def draw_policy(path: Path, experiment: Experiment, problem: Problem, policies: Any) -> None:
    """policy.gif: the lane with the best final return on the target."""
    _, curves = run_dir.read_metrics(path)
    best = int(np.argmax(curves["target_return"][:, -1]))
    policy = jax.tree.map(lambda x: x[best], policies)
    key = jax.random.key(experiment.lanes[best].seed)
    episode = episodes.greedy(problem.space, problem.trainer, policy, problem.target, key)
    film.save(path / "policy.gif", problem.space, problem.target, episode, robot=False)
