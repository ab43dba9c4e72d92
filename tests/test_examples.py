"""The examples to start one's own plug-ins from work as they are."""

from __future__ import annotations

import dataclasses
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import envs
from apt_jax.config import PRESETS
from experiments.examples import corridor

ROOT = Path(__file__).parents[1]

TRAIN = shlex.split(
    """-m experiments.train --plugins experiments.examples.corridor --space corridor --target far --method random
    --preset paper --seeds 0 1
    --env-steps 80 --config.warmup-steps 40 --config.eval-every 20 --config.refresh-every 20 --config.replay-steps 60
    --config.recent-steps 20 --config.replay-episodes 8 --config.return-window 8 --config.batch-size 4
    --config.eval-episodes 2 --config.probe-tasks 2 --devices 1"""
)


def test_a_task_space_of_one_s_own_is_trained_and_pictured_from_the_command_line(tmp_path, monkeypatch):
    run = tmp_path / "runs" / "A"
    command = [sys.executable, *TRAIN, "--run-dir", str(run)]
    subprocess.run(command, cwd=ROOT, env=os.environ | {"JAX_PLATFORMS": "cpu"}, check=True, stdout=subprocess.DEVNULL)
    assert {"summary.json", "learning_curves.png", "progression.png", "policy.gif"} <= {file.name for file in run.iterdir()}

    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(envs.SPACES, "corridor", corridor.Corridor)
    _, what_was_learned = readme_python()
    assert 1 <= len(execute(what_was_learned)["episode"].actions) <= corridor.Corridor.horizon


def test_the_readme_trains_lanes_of_one_program(monkeypatch):
    config, hparams = PRESETS["fast"]
    small = {"warmup_steps": 1_000, "eval_every": 100, "refresh_every": 100, "probe_tasks": 2, "updates_per_step": 1}
    fewer = {"replay_steps": 1_000, "recent_steps": 500, "replay_episodes": 100}
    monkeypatch.setitem(PRESETS, "fast", (dataclasses.replace(config, method="random", **small, **fewer), hparams))
    lanes, _ = readme_python()
    seen = execute(lanes)
    assert int(seen["clock"].env_steps) == 1_300
    assert seen["metrics"]["target_return"].shape[0] >= 3


def readme_python() -> list[str]:
    """Its blocks of Python, in order."""
    return re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), flags=re.DOTALL)


def execute(source):
    names = {}
    exec(compile(source, "README.md", "exec"), names)
    return names


def test_the_corridor_says_which_targets_there_are():
    space = corridor.Corridor()
    assert {name: int(space.parse_target(text)) for name, text in space.targets.items()} == {"near": 3, "far": 7}
    for text in ("0", "9", "left"):
        with pytest.raises(ValueError, match=f"the goal's tile, 1 to 8, got '{text}'"):
            space.parse_target(text)
