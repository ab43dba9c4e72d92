"""The whole trainer on Manipulation, through the protocol alone."""

from __future__ import annotations

import csv
import re
import shlex

import numpy as np
import pytest
from PIL import Image

import envs
from apt_jax.checks import check_target
from apt_jax.config import PRESETS
from apt_jax.trainer import make_trainer
from experiments import command_line, pictures, progression, run_dir, settings, train
from experiments.errors import UsageError
from experiments.problem import make_problem
from experiments.runner import load_lanes
from tests.tables import SPACE

TABLE = """
FF..FF
FFFFFF
FF#FFF
FFFFFF
can 20 20
can 80 10
range 30
"""
OPTIONS = shlex.split(
    """--space manipulation --preset paper --method apt_gen --seeds 0 --env-steps 180 --devices 1 --config.envs-per-source 2
    --config.warmup-steps 60 --config.updates-per-step 1 --config.batch-size 8 --config.replay-steps 100
    --config.replay-episodes 16 --config.model-updates-per-step 0.25 --config.model-batch-size 4 --config.recent-steps 60
    --config.refresh-every 4 --config.eval-every 60 --config.eval-episodes 2 --config.probe-tasks 2 --config.return-window 4"""
)
UNDEFINED = {"probe_goal_way", "probe_can_distance"}
"""Metrics that are NaN if no proposed task has the cans they are about.

120 steps after the warm-up every environment has ended an episode that began after it, at the latest."""


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_makes_a_trainer(preset):
    make_trainer(SPACE, PRESETS[preset][0])


@pytest.mark.parametrize("target", SPACE.targets)
def test_every_target_is_a_task_of_the_space(target):
    check_target(SPACE, envs.load_target("manipulation", target))


@pytest.fixture(scope="module")
def own_table_run(tmp_path_factory):
    """A run on a user's own table, from the command line."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine.txt").write_text(TABLE)
    options = [*OPTIONS, "--target", str(folder / "mine.txt"), "--run-dir", str(folder / "run")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "draw", lambda *_: None)
        assert train.train(*command_line.parse(options)) == 0
    return folder / "run"


def test_a_users_own_table_is_trained_on(own_table_run):
    with (own_table_run / "metrics.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(int(row["seed"]), int(row["env_steps"])) for row in rows] == [(0, 120), (0, 180)]
    assert {name for name, value in rows[-1].items() if not np.isfinite(float(value))} <= UNDEFINED
    for row in rows:
        assert 0 <= float(row["probe_pits"]) + float(row["probe_roadblocks"]) <= 1
    assert (own_table_run / "target.txt").read_text() == TABLE


def test_what_was_saved_is_where_the_table_has_it(own_table_run):
    experiment = settings.load(own_table_run)
    states, clock, _ = load_lanes(own_table_run, experiment, make_problem(experiment).trainer)
    positions = np.asarray(states.workers.obs["positions"][0])
    assert clock.env_steps == 180
    assert np.isfinite(positions).all()
    assert (positions[0, :, :4] != -1).all(), "the target's two cans are there"
    assert (positions[0, :, 4:6] == -1).all(), "and no third"


def test_a_table_with_a_mistake_is_refused_at_once(tmp_path):
    (tmp_path / "mine.txt").write_text(TABLE.replace("#", "x"))
    with pytest.raises(UsageError, match=re.escape("mine.txt: line 4, column 3: unknown character 'x'")):
        train.train(*command_line.parse([*OPTIONS, "--target", str(tmp_path / "mine.txt"), "--run-dir", str(tmp_path / "run")]))
    assert not (tmp_path / "run").exists()


def test_the_progression_is_drawn_anew_also_with_the_robot(own_table_run, tmp_path):
    progression.draw(progression.Args(own_table_run, tmp_path / "above.png"))
    assert (tmp_path / "above.png").stat().st_size > 1000
    try:
        progression.draw(progression.Args(own_table_run, tmp_path / "robot.png", robot=True))
    except UsageError as error:
        pytest.skip(str(error))
    with Image.open(tmp_path / "above.png") as above, Image.open(tmp_path / "robot.png") as robot:
        assert robot.width == above.width
        for picture, expected in ((above, False), (robot, True)):
            red, green, blue = np.moveaxis(np.asarray(picture.convert("RGB"), int), -1, 0)
            assert (((red > 80) & (red > 3 * green) & (red > 3 * blue)).sum() > 100) == expected, "the robot is red"


def test_mistakes_about_the_progression_are_told(own_table_run, tmp_path, monkeypatch):
    def draw(**options):
        progression.draw(progression.Args(**{"run_dir": own_table_run, "out": tmp_path / "it.png", **options}))

    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="file is no directory"):
        draw(out=tmp_path / "file" / "it.png")
    with pytest.raises(UsageError, match=r"config\.json"):
        draw(run_dir=tmp_path)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(UsageError, match="--robot: MUJOCO_GL is 'glfw'"):
        draw(robot=True)
    monkeypatch.setattr(run_dir, "task_files", lambda _: {})
    with pytest.raises(UsageError, match="holds no generated tasks"):
        draw()
    assert not (tmp_path / "it.png").exists()
