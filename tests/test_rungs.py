"""What is asked along a ladder, on numbers made up for it."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from apt_jax.config import PRESETS, HParams
from apt_jax.lanes import stack_hparams
from apt_jax.task_space import task_struct
from apt_jax.trainer import make_trainer
from experiments import command_line, rungs, train
from experiments.errors import UsageError
from experiments.ladder import build
from experiments.run_dir import RunDir

LADDER = build(envs.load_target("grid_world", "A"))


def made_up(rng, lanes=2, tasks=4):
    """Judgements that rise with the rung, of tasks of which all on the first rungs are solved."""
    shape = (lanes, len(LADDER.steps), tasks)
    rung = np.broadcast_to(LADDER.steps[:, None], shape)
    noise = rng.normal(size=shape)
    return rungs.Judgement(rung + 1e-3 * noise, noise, -rung, -rung + 1e-3 * noise, rung < 3)


def test_tasks_are_chosen_by_rung():
    w = rungs.choose(LADDER, 3, seed=1)
    tasks = jax.vmap(envs.make("grid_world").instantiate)(w)
    found = jax.vmap(lambda task: envs.make("grid_world").describe(task, task)["solution_length"])(tasks)
    np.testing.assert_array_equal(np.asarray(found).reshape(-1, 3), np.repeat(LADDER.steps[:, None], 3, axis=1))


def test_table_and_correlations():
    judged = made_up(np.random.default_rng(0))
    lines = rungs.table(LADDER, judged).splitlines()
    assert len(lines) == 2 + len(LADDER.steps)
    assert lines[2].startswith("| 1 | 1.00 | 1.00 | - |")
    assert lines[4].startswith("| 3 | 3.00 | - | 3.00 |")
    assert lines[4].endswith("| -3.00 | -3.00 | 0.00 |")
    cells = rungs.correlations(["seed 0", "seed 1"], LADDER, judged).splitlines()[2].split(" | ")
    assert float(cells[1]) > 0.99
    assert abs(float(cells[2])) < 0.3
    assert cells[4] == "+1.00 |"


def test_models_of_every_lane_judge_every_task():
    config = dataclasses.replace(PRESETS["fast"][0], replay_steps=50_000)
    trainer = make_trainer(envs.make("grid_world"), config)
    hparams = stack_hparams([HParams()] * 2)
    keys = jax.eval_shape(lambda: jax.vmap(jax.random.key)(jnp.arange(2)))
    states = jax.eval_shape(jax.vmap(trainer.init, (0, None, 0)), keys, task_struct(trainer.space), hparams)
    w = rungs.choose(LADDER, 3, seed=1)
    policies = states.learner.target_params
    judged = jax.eval_shape(
        lambda *judges: rungs.judge(trainer, *judges, hparams, w, jax.random.key(0)), policies, states.curriculum
    )
    assert {x.shape for x in judged} == {(2, 3 * len(LADDER.steps))}


def test_only_apt_gen_has_what_is_asked_about(tmp_path, monkeypatch):
    experiment, session = command_line.parse(["--run-dir", str(tmp_path), "--method", "random"])
    train.open_run(RunDir(session.run_dir), experiment, session)
    monkeypatch.setattr("sys.argv", ["rungs", "--run-dir", str(tmp_path)])
    monkeypatch.setattr("experiments.runtime.setup", lambda: None)
    with pytest.raises(UsageError, match="is no run of apt_gen but of random"):
        rungs.main()
