"""A run that is interrupted, killed, or moved between machines ends like one that nothing happened to."""

from __future__ import annotations

import csv
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

import envs
from apt_jax import checkpoint
from experiments import command_line, compare, pictures, settings, train
from experiments.compare import Compare
from experiments.examples.corridor import Corridor
from experiments.problem import make_problem
from experiments.run_dir import RunDir
from experiments.runner import Runner, lane_inputs, load_states
from tests import corridor_runs
from tests.corridor_runs import OPTIONS

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Compiled programs, shared by the processes of these tests."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def start(cache):
    def popen(*options: str, stderr: int | None = None) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.corridor_runs", *options]
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PLATFORMS": "cpu"}
        return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=stderr, text=True)

    return popen


@pytest.fixture(scope="module")
def whole(tmp_path_factory, start):
    """A run in one process, without a break."""
    run = tmp_path_factory.mktemp("whole") / "run"
    with start("--run-dir", str(run), "--target", "far", "--method", "random", *OPTIONS) as process:
        process.communicate()
    assert process.returncode == 0
    return run


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    monkeypatch.setattr(corridor_runs.pictures, "draw", None)  # both are as they were afterwards
    monkeypatch.setitem(envs.SPACES, "corridor", None)
    corridor_runs.register()


def rows(run: Path) -> list[dict[str, str]]:
    """metrics.csv without the times."""
    with (run / "metrics.csv").open() as stream:
        return [{name: value for name, value in row.items() if name != "wall_seconds"} for row in csv.DictReader(stream)]


def assert_same_run(one: Path, other: Path) -> None:
    """Metrics and the whole saved state, bit for bit."""
    assert rows(one) == rows(other)
    assert len(rows(one)) == 9 * 20
    for a, b in zip(jax.tree.leaves(saved(one)), jax.tree.leaves(saved(other)), strict=True):
        np.testing.assert_array_equal(raw(a), raw(b))


def saved(run: Path):
    experiment = settings.load(run)
    mesh = Mesh(np.array(jax.devices()[:1]), ("lane",))
    return load_states(RunDir(run).checkpoints, make_problem(experiment).trainer, *lane_inputs(experiment), mesh)


def raw(leaf):
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def meeting_place() -> list[str]:
    """The options by which two processes find each other, but for the number of each."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    return ["--distributed", "--coordinator-address", address, "--num-processes", "2", "--process-id"]


def test_what_one_process_lacks_stops_both(tmp_path, start):
    """As a file or a plug-in that only one host has."""
    options = ["--run-dir", str(tmp_path / "run"), "--method", "random", *OPTIONS, "--devices", "1"]
    meet = meeting_place()
    with (
        start(*options, "--target", "far", *meet, "0", stderr=subprocess.PIPE) as first,
        start(*options, "--target", "nowhere", *meet, "1", stderr=subprocess.PIPE) as second,
    ):
        told = [process.communicate(timeout=120)[1] for process in (first, second)]
    assert 0 not in (first.returncode, second.returncode)
    assert "stopped, because another process did" in told[0]
    assert "unknown target of corridor 'nowhere'" in told[1]


def test_two_processes_train_as_one_and_one_goes_on_for_both(tmp_path, start, whole):
    """Nine lanes on the eight devices of two processes, which one interrupt stops together, then on two devices."""
    run = tmp_path / "run"
    distributed, *address = meeting_place()
    options = ["--run-dir", str(run), "--target", "far", "--method", "random", *OPTIONS, "--devices", "4", distributed]
    with start(*options, *address, "0") as first, start(*options, *address, "1") as second:
        next(line for line in first.stdout if "steps/s" in line)
        second.send_signal(signal.SIGINT)
        told, silent = first.stdout.read(), second.stdout.read()
    assert first.returncode == second.returncode == 130
    assert f"--resume --devices 4 --distributed {' '.join(address)} 0" in told
    assert "steps" not in silent
    done = rows(run)
    assert 0 < len(done) < 9 * 20
    assert done == rows(whole)[: len(done)]

    with (run / "metrics.csv").open("a") as stream:
        stream.write("3,1")  # as a process killed while writing leaves it
    with start("--run-dir", str(run), "--resume", "--devices", "2") as process:
        process.communicate()
    assert process.returncode == 0
    assert_same_run(run, whole)


def test_an_interrupt_during_the_last_pictures_stops_what_would_come_next(tmp_path, monkeypatch):
    monkeypatch.setitem(envs.SPACES, "corridor", Corridor)
    monkeypatch.setattr(pictures, "draw", lambda *_: os.kill(os.getpid(), signal.SIGINT))
    comparison = Compare(tmp_path, methods=("dqn", "random"), targets=("far",))
    runs = compare.plan(comparison, [*OPTIONS, "--seeds", "0", "--env-steps", "60"])
    assert compare.make_in_turn(runs) == 130
    assert (tmp_path / "far" / "dqn" / "summary.json").exists()
    assert not (tmp_path / "far" / "random").exists()


def test_an_interrupt_during_the_warm_up_saves_it(tmp_path, monkeypatch):
    warmup = Runner.warmup

    def interrupted(runner):
        warmup(runner)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Runner, "warmup", interrupted)
    run = tmp_path / "run"
    options = ["--target", "far", "--method", "dqn", *OPTIONS, "--seeds", "0", "--env-steps", "60"]
    assert train.train(*command_line.parse(["--run-dir", str(run), *options])) == 130
    assert checkpoint.latest_step(run / "checkpoints") == 40
    monkeypatch.setattr(Runner, "warmup", None)  # it is not made again
    assert train.train(*command_line.parse(["--run-dir", str(run), "--resume"])) == 0
    assert [row["env_steps"] for row in rows(run)] == ["60"]


def test_a_seed_is_the_same_on_eight_devices(tmp_path, start, whole):
    """Two chunks of nine lanes, as on two devices up to the order of float sums; `test_trainer` compares two with one."""
    run = tmp_path / "run"
    options = ["--target", "far", "--method", "random", *OPTIONS, "--env-steps", "80", "--devices", "8"]
    with start("--run-dir", str(run), *options) as process:
        process.communicate()
    assert process.returncode == 0
    for row, expected in zip(rows(run), rows(whole)[: 9 * 2], strict=True):
        assert row.keys() == expected.keys()
        values, wanted = (np.array(list(one.values()), float) for one in (row, expected))
        np.testing.assert_allclose(values, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_a_job_whose_worker_is_killed_goes_on_from_its_checkpoint(tmp_path, monkeypatch, cache, whole, capfd):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(cache))
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_worker_niceness", "0")  # by default workers yield to everything else on a busy machine
    monkeypatch.setattr(compare, "make_alone", corridor_runs.make_and_be_killed_once)
    comparison = Compare(tmp_path, methods=("random",), targets=("far",), ray=True)
    runs = compare.plan(comparison, OPTIONS)
    assert compare.make_on_ray(comparison, runs) == 0
    run = tmp_path / "far" / "random"
    assert run.with_suffix(".killed").exists()
    assert "restored 200 steps" in capfd.readouterr().out
    assert_same_run(run, whole)
