"""Training from the command line: refusals, the files of a run, interrupts and resumption."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import envs
from apt_jax import checkpoint
from apt_jax.config import PRESETS, Config, HParams
from apt_jax.methods import METHODS
from experiments import command_line, evaluate, presets, run_dir, settings, sinks, train
from experiments.errors import UsageError
from experiments.problem import load_target, make_problem
from experiments.run_dir import RunDir
from experiments.settings import Experiment, Session
from experiments.summary import is_complete

ROOT = Path(__file__).parents[1]

TINY = shlex.split(
    """--preset paper --method random --seeds 3 0 5 --env-steps 1200 --config.warmup-steps 200 --config.eval-every 100
    --config.refresh-every 100 --config.replay-steps 400 --config.recent-steps 200 --config.replay-episodes 50
    --config.updates-per-step 1 --config.batch-size 4 --config.eval-episodes 2 --config.probe-tasks 2"""
)


def start_run(path: Path, *options: str) -> Experiment:
    """A run directory as the script leaves it before its first chunk."""
    experiment, session = command_line.parse(["--run-dir", str(path), *options])
    train.open_run(RunDir(session.run_dir), experiment, session)
    return experiment


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--seeds 1 2 1", "--seeds needs .* different .* got 1 2 1"),
        ("--seeds -1", "--seeds must lie in .* got -1"),
        ("--seeds 0 4294967296", "--seeds must lie in .* got 4294967296"),
        ("--hparams.delta 0.1 0.1", "--hparams.delta needs .* different numbers, got 0.1 0.1"),
        ("--hparams.delta nan", "delta must be finite, got nan"),
        ("--hparams.gamma 0.9 1.5", "gamma must be in .* got 1.5"),
        ("--method apt_gen+rdn", "closest is 'rnd'"),
        ("--devices 0", "--devices must be from 1 to 1,024, got 0"),
        ("--num-processes 2", "--num-processes and --process-id need --distributed"),
        ("--distributed --coordinator-address node1", "must be a host and a port as in node1:1234, got node1"),
        ("--distributed --num-processes 2 --process-id 2", "--process-id must be from 0 to .* got 2 of 2"),
        ("--checkpoint-every 0", "--checkpoint-every must be at least 1"),
        ("--devices 100000", "--devices must be from 1 to 1,024, got 100000"),
        ("--config.replay-steps 10000000000", "replay_steps must be .* at most 1073741823, got 10000000000"),
        ("--target missing.txt", "missing.txt is no file"),
        ("--env-steps 10000", r"warmup_steps \(10000\) .* is 11000"),
        ("--env-steps 2147484000", r"--env-steps must be below 2\^31, got 2147484000"),
        ("--hparams.learning-rate inf", "learning_rate must be finite and at least 0, got inf"),
        ("--hparams.beta-max inf", "beta_max must be finite and above 0, got inf"),
        ("--hparams.delta 1e300", "delta must be finite, got 1e\\+300"),
        ("--hparams.epsilon-steps 1e-50", "epsilon_steps must be above 0, got 1e-50"),
        ("--hparams.beta-min 9", "beta_min must be at most beta_max=8, got 9"),
        ("--hparams.value-weight-decay 5000", "value_learning_rate .* at most 1, got 1.5"),
        ("--method alp_gmm --config.refresh-every 0", "refresh_every must be at least 1, got 0"),
        ("--env-steps 20400", r"eval_every \(1000\); closest to 20400 is 20000"),
        ("--space gird_world", "closest is 'grid_world'"),
        ("--plugins experiments.laddr", "--plugins experiments.laddr: No module named 'experiments.laddr'"),
        ("--target a", "closest is 'A'"),
        ("--method apt-gen", "closest is 'apt_gen'"),
        ("--config.model-updates-per-step inf", "whole number of updates per iteration"),
        ("--config.envs-per-source 1", r"per iteration of 2 environment steps .*, got 0.2, which gives 0.4"),
        ("--config.envs-per-source 3", r"multiple of 6, .* \(2 sources of envs_per_source=3\), got 10000"),
        ("--config.batch-size 5", "batch_size must be a positive multiple"),
        ("--resume", "holds no run"),
    ],
)
def test_mistakes_are_told_before_anything_is_written(tmp_path, options, message):
    def prepare():
        experiment, _ = command_line.parse(["--run-dir", str(tmp_path / "run"), *options.split()])
        make_problem(experiment)

    with pytest.raises(UsageError, match=message):
        prepare()
    assert not (tmp_path / "run").exists()


def test_options_override_the_preset(tmp_path):
    experiment, _ = command_line.parse(
        ["--run-dir", str(tmp_path), "--preset", "fast", "--config.batch-size", "64", "--hparams.delta", "0.3"]
    )
    config, hparams = PRESETS["fast"]
    assert experiment.config == dataclasses.replace(config, batch_size=64)
    assert experiment.hparams == hparams.replace(delta=0.3)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(("option", "value"), [("--config.judge-parts", True), ("--config.no-judge-parts", False)])
def test_a_switch_has_both_names_whatever_the_preset(tmp_path, preset, option, value):
    experiment, _ = command_line.parse(["--run-dir", str(tmp_path), "--preset", preset, option])
    assert experiment.config.judge_parts == value


@pytest.mark.parametrize("space", ["manipulation", "manipulation_sawyer"])
def test_a_space_may_have_a_discount_of_its_own(tmp_path, space):
    words = ["--run-dir", str(tmp_path), "--preset", "fast", "--space", space]
    experiment, _ = command_line.parse(words)
    assert experiment.hparams == PRESETS["fast"][1].replace(gamma=presets.GAMMA["manipulation"])
    experiment, _ = command_line.parse([*words, "--hparams.gamma", "0.9"])
    assert experiment.hparams.gamma == 0.9


@pytest.mark.parametrize("option", ["--method", "--config.method"])
def test_a_method_may_be_tuned_in_preset_fast(tmp_path, option):
    def parse(*options):
        return command_line.parse(["--run-dir", str(tmp_path), *options])[0]

    tuned = presets.TUNED["grid_world", "rnd"]
    assert parse("--preset", "fast", option, "rnd").hparams == PRESETS["fast"][1].replace(**tuned)
    assert parse("--preset", "fast", option, "rnd", "--hparams.rnd-scale", "0.7").hparams.rnd_scale == 0.7
    assert (
        parse("--preset", "fast", "--method", "dqn", "--config.method", "rnd").hparams.gamma
        == presets.TUNED["grid_world", "dqn"]["gamma"]
    )
    assert parse("--preset", "fast", option, "apt_gen+rnd").hparams == PRESETS["fast"][1]
    assert parse("--preset", "paper", option, "rnd").hparams == HParams()


@pytest.mark.parametrize(("space", "method"), presets.TUNED)
def test_what_is_tuned_exists(tmp_path, space, method):
    envs.make(space)
    assert method in METHODS
    words = ["--run-dir", str(tmp_path), "--preset", "fast", "--space", space, "--method", method]
    experiment = command_line.parse(words)[0]
    assert (experiment.config, experiment.hparams) == presets.starting_point("fast", space, method)
    assert experiment.config.method == method
    assert experiment.hparams != presets.starting_point("fast", space, "apt_gen")[1]


def test_a_file_does_not_hide_a_target_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("A", "mine"):
        Path(name).write_text("")
    assert settings.target_path("grid_world", "A") is None
    assert settings.target_path("grid_world", "mine") == Path("mine")
    assert settings.target_path("grid_world", "yours") is None


def test_a_file_named_like_a_target_of_a_plug_in_is_refused(tmp_path, monkeypatch):
    """Until the plug-in is imported, nobody knows that there is such a target."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(envs, "SPACES", {name: space for name, space in envs.SPACES.items() if name != "corridor"})
    monkeypatch.delitem(sys.modules, "experiments.examples.corridor", raising=False)
    Path("far").write_text("3")
    options = "--plugins experiments.examples.corridor --space corridor --run-dir run --target"
    experiment, _ = command_line.parse([*options.split(), "far"])
    with pytest.raises(UsageError, match="--target far is both a target of corridor and a file here"):
        make_problem(experiment)
    Path("far").rename("other")
    assert command_line.parse([*options.split(), "other"])[0].target_file == Path("other")


def test_a_step_of_a_plug_in_is_checked_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(envs, "SPACES", dict(envs.SPACES))
    (tmp_path / "owing.py").write_text(
        "import envs\nfrom experiments.examples.corridor import Corridor\n"
        "class Owing(Corridor):\n"
        "    name = 'owing'\n"
        "    def step(self, state, action, task):\n"
        "        return tuple(super().step(state, action, task))\n"
        "envs.SPACES['owing'] = Owing\n"
    )
    options = "--plugins owing --space owing --target far --method dqn --config.warmup-steps 100 --env-steps 1100"
    experiment, _ = command_line.parse(["--run-dir", str(tmp_path / "run"), *options.split()])
    with pytest.raises(UsageError, match=r"owing.step must return a StepOutput, got tuple"):
        make_problem(experiment)


def test_help_names_every_space_and_method():
    text = f"{settings.Experiment.__doc__} {settings.Session.__doc__}"
    assert all(name in text for name in (*envs.SPACES, *METHODS))


def test_a_target_file_without_a_solution_is_refused(tmp_path):
    closed, open_ = tmp_path / "closed.txt", tmp_path / "open.txt"
    rows = ["A......."] + ["........"] * 5 + ["......##", "......#G"]
    closed.write_text("\n".join(rows))
    open_.write_text("\n".join([*rows[:-2], "........", rows[-1]]))
    with pytest.raises(UsageError, match=r"closed.txt: no 50 steps, an episode's longest, solve this task"):
        load_target("grid_world", str(closed), closed)
    load_target("grid_world", str(open_), open_)


def test_several_values_are_a_sweep_over_every_seed(tmp_path):
    deltas = ["-0.1", "0.1", "0.3", "0.5", "0.7", "0.9", "1.1"]
    experiment = start_run(tmp_path, "--seeds", "0", "1", "2", "3", "4", "--hparams.delta", *deltas, "--hparams.gamma", "0.9")
    lanes = experiment.lanes
    assert len(lanes) == 35
    assert lanes[6].index == {"seed": 1, "delta": 0.1}
    assert lanes[6].name == "seed 1, delta 0.1"
    assert lanes[6].hparams == PRESETS["fast"][1].replace(delta=0.1, gamma=0.9)
    assert settings.load(tmp_path) == experiment
    assert command_line.parse(["--run-dir", str(tmp_path), "--resume"])[0] == experiment
    with pytest.raises(UsageError, match=r"hparams.delta \(saved \(-0.1, .*, asked 0.5\)"):
        command_line.parse(["--run-dir", str(tmp_path), "--resume", "--hparams.delta", "0.5"])


def test_rows_with_other_columns_are_refused_and_what_is_there_stays(tmp_path):
    run = RunDir(tmp_path / "run")
    run.create({}, None)
    run.append_metrics(100, 0.5, [{"seed": 0}], {"target_return": np.float32([1])})
    before = (run.path / "metrics.csv").read_text()
    with pytest.raises(UsageError, match=r"other columns \(beta\)"):
        run.append_metrics(200, 0.5, [{"seed": 0}], {"beta": np.float32([1]), "target_return": np.float32([1])})
    assert (run.path / "metrics.csv").read_text() == before


def test_rows_of_a_sweep_are_told_apart_by_their_columns(tmp_path):
    run = RunDir(tmp_path / "run")
    run.create({}, None)
    lanes = [lane.index for lane in Experiment(seeds=(4, 2), hparams=HParams(delta=(0.1, 0.3))).lanes]
    for step in (100, 200):
        run.append_metrics(step, 0.5, lanes, {"target_return": np.float32([1, 2, 3, 4]) * step})
    assert (run.path / "metrics.csv").read_text().startswith("seed,delta,env_steps,wall_seconds,target_return\n")
    read = run_dir.read_settings(run.path)
    assert list(read) == ["delta 0.1", "delta 0.3"]
    env_steps, curves = read["delta 0.3"]
    assert env_steps.tolist() == [100, 200]
    np.testing.assert_array_equal(curves["seed"][:, 0], [4, 2])
    np.testing.assert_array_equal(curves["target_return"], [[300, 600], [400, 800]])


def test_a_run_is_never_overwritten(tmp_path):
    start_run(tmp_path / "run")
    before = (tmp_path / "run" / "config.json").read_bytes()
    with pytest.raises(UsageError, match="not empty; pass --resume"):
        start_run(tmp_path / "run", "--seeds", "7")
    assert (tmp_path / "run" / "config.json").read_bytes() == before


def test_resuming_defaults_to_the_saved_experiment(tmp_path):
    saved = start_run(tmp_path, *TINY)
    resumed, _ = command_line.parse(["--run-dir", str(tmp_path), "--resume"])
    assert resumed == saved
    longer, _ = command_line.parse(["--run-dir", str(tmp_path), "--resume", "--env-steps", "3000"])
    assert longer == dataclasses.replace(saved, env_steps=3000)


def test_a_preset_named_again_keeps_the_method(tmp_path):
    saved = start_run(tmp_path, "--preset", "fast", "--method", "dqn")
    assert command_line.parse(["--run-dir", str(tmp_path), "--resume", "--preset", "fast"])[0] == saved


def test_resuming_names_every_difference(tmp_path):
    start_run(tmp_path, *TINY)
    options = "--resume --config.batch-size 8 --hparams.delta 0.3 --target B"
    with pytest.raises(UsageError) as caught:
        command_line.parse(["--run-dir", str(tmp_path), *options.split()])
    for difference in ("config.batch_size (saved 4, asked 8)", "hparams.delta (saved 0.5, asked 0.3)", "target (saved A"):
        assert difference in str(caught.value)
    assert "seeds" not in str(caught.value)
    with pytest.raises(UsageError, match="saved 1200, asked 1000"):
        command_line.parse(["--run-dir", str(tmp_path), "--resume", "--env-steps", "1000"])


def test_a_target_file_named_again_is_the_one_that_the_run_has_kept(tmp_path):
    file = tmp_path / "mine.txt"
    file.write_text("first")
    start_run(tmp_path / "run", "--target", str(file))
    resume = ["--run-dir", str(tmp_path / "run"), "--resume", "--target", str(file)]
    assert command_line.parse(resume)[0].target == str(file)
    assert command_line.parse(resume[:-2])[0].target_file == tmp_path / "run" / "target.txt"
    with pytest.raises(UsageError, match=r"target \(saved of a file, asked B\)"):
        command_line.parse([*resume[:-1], "B"])
    copy = tmp_path / "copy.txt"
    copy.write_text("first")
    command_line.parse([*resume[:-1], str(copy)])
    file.write_text("second")
    with pytest.raises(UsageError, match=r"target_file \(saved first, asked second\)"):
        command_line.parse(resume)
    file.unlink()
    assert command_line.parse(resume)[0].target_file == tmp_path / "run" / "target.txt"
    (tmp_path / "run" / "target.txt").unlink()
    with pytest.raises(UsageError, match=r"target.txt is no file"):
        command_line.parse(resume)


def test_infinite_values_of_a_sweep_are_saved_and_read(tmp_path):
    experiment = start_run(tmp_path / "run", "--hparams.spectral-bound", "0.8", "inf")
    assert settings.load(tmp_path / "run") == experiment
    assert experiment.hparams.spectral_bound == (0.8, math.inf)


def test_lanes_of_large_seeds_have_names_of_their_own():
    names = [lane.name for lane in Experiment(seeds=(20240101, 20240102, 2**31 - 1), hparams=HParams(delta=(0.1, 3e-4))).lanes]
    assert len(set(names)) == 6
    assert names[0] == "seed 20240101, delta 0.1"
    assert names[-1] == "seed 2147483647, delta 0.0003"


def test_the_resume_command_repeats_how_not_what(tmp_path):
    session = Session(Path("my run"), devices=1, sinks=("tensorboard",), method="random")
    assert session.resume_command == ("python -m experiments.train --run-dir 'my run' --resume --devices 1 --sinks tensorboard")


@pytest.mark.parametrize("kept", range(1, 60, 7))
def test_metrics_cut_off_anywhere_are_read_up_to_the_last_evaluation_of_all_seeds(tmp_path, kept):
    run = RunDir(tmp_path / "run")
    run.create({}, None)
    with pytest.raises(UsageError, match="no evaluation yet"):
        run_dir.read_metrics(run.path)
    for step in (100, 200):
        run.append_metrics(step, 0.5, [{"seed": 4}, {"seed": 2}], {"target_return": np.float32([0.25, -0.25])})
    whole = (run.path / "metrics.csv").read_text()
    second = whole.index("4,200")
    (run.path / "metrics.csv").write_text(whole[: second + min(kept, len(whole) - second - 1)])
    env_steps, curves = run_dir.read_metrics(run.path)
    assert env_steps.tolist() == [100]
    np.testing.assert_array_equal(curves["target_return"], [[0.25], [-0.25]])


def test_one_process_at_a_time_writes_to_a_run(tmp_path):
    experiment, session = command_line.parse(["--run-dir", str(tmp_path / "run")])
    first = RunDir(session.run_dir)
    train.open_run(first, experiment, session)
    again = command_line.parse(["--run-dir", str(tmp_path / "run"), "--resume"])
    with pytest.raises(UsageError, match="another process is at work on"):
        train.open_run(RunDir(session.run_dir), *again)
    first.release()
    assert train.open_run(RunDir(session.run_dir), *again) == 0


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("config.json", '{"space": ', "config.json is damaged"),
        ("metrics.csv", "seed,env_steps,target_return\n0,100,abc0.0\n", "metrics.csv is damaged: could not convert"),
        ("metrics.csv", "0,100,0.5\n0,200,0.5\n", "metrics.csv is damaged: 'env_steps' is not in list"),
        ("metrics.csv", "seed,env_steps,target_return\n0,200,0.5\n0,200,0.5\n", "metrics.csv is damaged: its rows"),
        ("metrics.csv", "seed,env_steps,target_return\n0,100,0.5\n1,200,0.5\n", "metrics.csv is damaged: its rows"),
    ],
)
def test_a_damaged_file_is_named(tmp_path, name, content, message):
    start_run(tmp_path / "run")
    (tmp_path / "run" / name).write_text(content)
    with pytest.raises(UsageError, match=message):
        run_dir.read_metrics(tmp_path / "run") if name == "metrics.csv" else settings.load(tmp_path / "run")


def test_a_damaged_summary_is_written_anew(tmp_path):
    experiment = start_run(tmp_path / "run")
    assert not is_complete(tmp_path / "run", experiment)
    (tmp_path / "run" / "summary.json").write_text('{"env_steps": 100000')
    assert not is_complete(tmp_path / "run", experiment)
    (tmp_path / "run" / "summary.json").write_text('{"env_steps": 100000}')
    assert is_complete(tmp_path / "run", experiment)


def test_rewinding_drops_what_came_after_the_checkpoint(tmp_path):
    run = RunDir(tmp_path / "run")
    run.create({}, None)
    for step in (100, 200, 300):
        run.append_metrics(step, step / 10, [{"seed": 4}, {"seed": 2}], {"target_return": np.float32([step, -step]) / 7})
        run.write_tasks(step, {"xy": np.zeros((2, 8, 3), np.float32)})
    run.rewind(200)
    env_steps, curves = run_dir.read_metrics(run.path)
    assert env_steps.tolist() == [100, 200]
    assert curves["seed"].tolist() == [[4, 4], [2, 2]]
    np.testing.assert_array_equal(np.float32(curves["target_return"][1]), np.float32([-100, -200]) / 7)
    assert list(run_dir.task_files(run.path)) == [100, 200]
    assert run_dir.wall_seconds(run.path) == 20
    run.rewind(0)
    assert not (run.path / "metrics.csv").exists()


def test_a_missing_sink_names_its_extra(monkeypatch):
    monkeypatch.setitem(sinks._MODULES, "wandb", "a_module_that_does_not_exist")
    with pytest.raises(UsageError, match=r"pip install -e '.\[wandb\]'"):
        sinks.check_installed(["wandb"])


def test_sessions_of_a_run_are_one_group_in_weights_and_biases(tmp_path, monkeypatch):
    runs = []

    class Run:
        def __init__(self, **options):
            self.group, self.logged, self.finished = options["group"], {}, False
            runs.append(self)

        def log(self, scalars, step):
            self.logged[step] = scalars

        def finish(self):
            self.finished = True

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=Run))
    for path in (tmp_path / "A" / "dqn", tmp_path / "B" / "dqn", tmp_path / "A" / "dqn"):
        (sink,) = sinks.make_sinks(["wandb"], path, start=0, lanes=Experiment(seeds=(3,)).lanes, config={})
        sink.write(100, {"beta": np.float32([1.0])})
        sink.close()
    assert runs[0].group == runs[2].group != runs[1].group
    assert all(run.logged == {100: {"beta/seed_3": 1.0}} and run.finished for run in runs)


def test_tensorboard_writes_events(tmp_path):
    (sink,) = sinks.make_sinks(["tensorboard"], tmp_path, start=0, lanes=Experiment(seeds=(0,)).lanes, config={})
    sink.write(100, {"beta": np.float32([1.0])})
    sink.close()
    assert list((tmp_path / "tensorboard").glob("events*"))


def test_an_interrupted_run_says_how_to_go_on_and_ends_complete(tmp_path, capsys):
    """That it ends like one that was never interrupted, `test_resuming` shows."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"), "JAX_PLATFORMS": "cpu"}

    def launch(*options: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "experiments.train", *options]
        return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)

    run = tmp_path / "run"
    with launch("--run-dir", str(run), *TINY) as process:
        assert process.stdout
        next(line for line in process.stdout if "steps/s" in line)
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
    assert process.returncode == 130
    command = re.search(r"to go on: python -m experiments.train (.*)", rest)
    assert command
    assert len(rows(run)) < 3 * 10
    with (run / "metrics.csv").open("a") as stream:
        stream.write("3,1")  # as a process killed while writing leaves it

    with launch(*shlex.split(command[1])) as process:
        output, _ = process.communicate()
    assert process.returncode == 0
    assert "\nloaded in " in output
    assert rows(run) == [(seed, step) for step in range(300, 1300, 100) for seed in (3, 0, 5)]
    summary = json.loads((run / "summary.json").read_text())
    assert [lane["seed"] for lane in summary["lanes"]] == [3, 0, 5]
    for name in ("learning_curves.png", "progression.png", "policy.gif", "tasks/seed_3.png"):
        assert (run / name).stat().st_size > 1000

    assert train.train(*command_line.parse(["--run-dir", str(run), "--resume"])) == 0
    assert "has all its 1,200 steps" in capsys.readouterr().out
    evaluate.evaluate(evaluate.Args(run, target=("B",), episodes=2, gif=tmp_path / "film.gif"))
    assert "B after 1,200 steps" in capsys.readouterr().out
    assert (tmp_path / "film.gif").exists()
    evaluate.evaluate(evaluate.Args(run, target=("B", "C"), episodes=2, csv=tmp_path / "scores.csv"))
    assert re.search("B after 1,200 steps(.|\n)*C after 1,200 steps", capsys.readouterr().out)
    with (tmp_path / "scores.csv").open() as stream:
        scores = list(csv.DictReader(stream))
    assert [(row["target"], row["lane"]) for row in scores] == [(t, f"seed {s}") for t in "BC" for s in (3, 0, 5)]
    assert all(-1.0 <= float(row["episode_return"]) <= 1.0 <= float(row["length"]) <= 50.0 for row in scores)
    with pytest.raises(UsageError, match="--gif films one --target, got B, C"):
        evaluate.evaluate(evaluate.Args(run, target=("B", "C"), gif=tmp_path / "film.gif"))

    kept = (run / "metrics.csv").read_bytes()
    shutil.rmtree(run / "checkpoints")
    assert train.train(*command_line.parse(["--run-dir", str(run), "--resume"])) == 0
    (run / "summary.json").unlink()  # as of a run that was killed
    with pytest.raises(UsageError, match="has results, but no checkpoint to go on from"):
        train.train(*command_line.parse(["--run-dir", str(run), "--resume", "--env-steps", "1300"]))
    assert (run / "metrics.csv").read_bytes() == kept
    assert len(run_dir.task_files(run)) > 0


def test_results_that_are_gone_are_not_begun_anew(tmp_path, monkeypatch):
    experiment, session = command_line.parse(["--run-dir", str(tmp_path / "run"), *TINY])
    run = RunDir(session.run_dir)
    train.open_run(run, experiment, session)
    run.release()
    again = command_line.parse(["--run-dir", str(tmp_path / "run"), "--resume"])
    monkeypatch.setattr(checkpoint, "latest_step", lambda _: 200)
    assert train.open_run(RunDir(session.run_dir), *again) == 200  # only the warm-up was saved
    monkeypatch.setattr(checkpoint, "latest_step", lambda _: 300)
    with pytest.raises(UsageError, match="a checkpoint of 300 steps, but no results"):
        train.open_run(RunDir(session.run_dir), *again)


def rows(path: Path) -> list[tuple[int, int]]:
    with (path / "metrics.csv").open() as stream:
        return [(int(row["seed"]), int(row["env_steps"])) for row in csv.DictReader(stream)]


def test_the_librarys_default_is_the_papers_and_the_command_lines_is_what_learns(tmp_path):
    assert Experiment().config == Config() == PRESETS["paper"][0]
    assert command_line.parse(["--run-dir", str(tmp_path)])[0].config == PRESETS["fast"][0]
