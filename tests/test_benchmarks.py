"""The benchmarks run and their results have the fields that readers rely on; no test depends on a timing."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tyro

import envs
from apt_jax import learner
from apt_jax.config import Config, HParams
from apt_jax.trainer import make_trainer
from experiments.benchmarks import __main__ as everything
from experiments.benchmarks import (
    _flops,
    _measure,
    capacity,
    dqn_peers,
    environments,
    growth,
    training_step,
    training_throughput,
    variants,
)
from experiments.benchmarks._grid_worlds import JaxWorld, restart
from experiments.benchmarks._stretched import Stretched
from experiments.examples.corridor import Corridor

CONFIG = Config(
    method="random",  # half the compilation of apt_gen; the pieces of its model update are timed all the same
    warmup_steps=30,
    updates_per_step=1,
    batch_size=4,
    replay_steps=100,
    replay_episodes=16,
    model_updates_per_step=0.5,
    model_batch_size=4,
    recent_steps=50,
    refresh_every=4,
    eval_every=8,
    eval_episodes=2,
    probe_tasks=2,
    return_window=5,
)


def one_second_each(*shape_and_args):
    """Instead of timing matmuls, each shape a compilation: a product takes a second."""
    return training_step.Matmul(*shape_and_args[:3], _measure.Timing((2.0,), 0.0), 1)


@pytest.fixture(scope="module")
def result():
    problem = _measure.Problem(Corridor(), np.int32(7), CONFIG, HParams())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_step, "time_matmul", one_second_each)
        return training_step.measure(problem, training_step.Args(repeats=2, at_least=0.0))


def test_every_part_of_a_training_step_is_timed(result):
    assert list(result.parts) == [
        "propose tasks",
        "act and step",
        "write",
        "sample",
        "update policy",
        "update models",
        "refresh",
        "evaluate",
    ]
    assert list(result.models) == ["sample rollouts", "discriminator", "values", "generator"]
    for timing in [*result.parts.values(), *result.models.values(), result.chunk, result.model_update]:
        assert len(timing.seconds) == 2
        assert all(seconds >= 0 for seconds in timing.seconds)


def test_results_of_a_training_step_are_json_and_a_table(result):
    content = json.loads(json.dumps(result, default=dataclasses.asdict))
    assert set(content) == {
        "config",
        "parts",
        "chunk",
        "shortest_chunk",
        "model_update",
        "models",
        "work",
    }
    text = training_step.tables({"tiny": result, "same": result}, rate=1e9)
    assert "| part | tiny: ms | tiny: of the sum | tiny: compile, s | same: ms |" in text
    assert "| sum of the parts |" in text
    evaluate = next(line for line in text.splitlines() if line.startswith("| evaluate |"))
    assert [cell.strip() for cell in evaluate.split("|")[4:8:3]] == ["", ""], "an evaluation is never compiled by itself"
    ratio = f"{result.chunk.median / result.sum_of_parts:.2f}"
    assert f"Whole / sum of the parts: {ratio} (tiny), {ratio} (same)." in text


def test_the_work_of_a_training_step_is_counted(result):
    policy, *models, jointly, step = result.work.values()
    assert all(one.flops >= one.matmul_flops > 0 for one in result.work.values())
    assert jointly.matmul_flops == sum(one.matmul_flops for one in models)
    assert jointly.matmul_seconds == sum(one.matmul_seconds for one in models) > 10  # products
    assert step.matmul_flops == CONFIG.updates_per_step * policy.matmul_flops + 0.5 * jointly.matmul_flops
    rows = training_step.work_rows({"half of it": training_step.Work(3e6, 2e6, 0.001, 0.004)}, rate=1e9)
    assert rows == {"half of it": ["2", "50.0%", "25.0%"]}


def test_a_matmul_is_timed_there_and_back():
    matmul = training_step.time_matmul(2, 3, 4, training_step.Args(repeats=2, at_least=0.0))
    assert matmul.flops == 2 * (2 * 2 * 3 * 4)
    assert matmul.rate > 0


def test_matmul_flops_count_the_runs_of_a_loop():
    def function(x, matrix):
        return jax.lax.scan(lambda carry, _: (carry @ matrix, None), x, length=3)[0] + jnp.tanh(x)

    assert _flops.matmul_flops(function, jnp.ones((2, 5)), jnp.ones((5, 5))) == 3 * 2 * 2 * 5 * 5


def test_matmul_flops_count_one_branch_of_a_condition():
    def function(x, matrix):
        return jax.lax.cond(x.sum() > 0, lambda: x, lambda: x @ matrix @ matrix)

    assert _flops.matmul_flops(function, jnp.ones((2, 5)), jnp.ones((5, 5))) == 2 * 2 * 2 * 5 * 5


def test_matmul_flops_count_batched_and_backward_products():
    def loss(x, y):
        return jnp.sum(jax.vmap(jnp.dot)(x, y))

    forward = 7 * 2 * 2 * 3 * 4
    assert _flops.matmul_flops(loss, jnp.ones((7, 2, 3)), jnp.ones((7, 3, 4))) == forward
    assert (
        _flops.matmul_flops(jax.value_and_grad(loss, argnums=(0, 1)), jnp.ones((7, 2, 3)), jnp.ones((7, 3, 4))) == 3 * forward
    )


def test_time_loop_keeps_the_callers_carry():
    carry = {"x": jnp.zeros(3), "key": jax.random.key(0)}
    timing = _measure.time_loop(lambda c, one: c | {"x": c["x"] + one}, carry, jnp.ones(3), repeats=4, at_least=0.0)
    assert len(timing.seconds) == 4
    assert timing.per(2).median == timing.median / 2
    np.testing.assert_array_equal(carry["x"], np.zeros(3))


@pytest.mark.parametrize(("value", "text"), [(0.0, "0"), (0.012345, "0.0123"), (12.345, "12.3"), (123456.0, "123,000")])
def test_numbers_in_tables(value, text):
    assert _measure.number(value) == text


def test_each_preset_fits_the_quick_sizes():
    for preset in training_step.Args().presets:
        for name in envs.SPACES:
            problem = _measure.load_problem(preset, space=name, **_measure.QUICK)
            make_trainer(problem.space, problem.config)


COUNTDOWN = JaxWorld(
    start=lambda key: {"left": jnp.int32(3), "draw": jax.random.uniform(key, (2,))},
    step=lambda state, action: {**state, "left": state["left"] - 1 - 0 * action},
    done=lambda state: state["left"] == 0,
    num_actions=2,
)
"""Episodes of three steps."""


@pytest.mark.parametrize("group", [1, 3])
def test_an_environment_restarts_where_its_episode_ended_and_only_there(group):
    left = jnp.array([0, 2, 0, 0, 1, 0, 2, 0], jnp.int32)
    states = {"left": left, "draw": jnp.full((8, 2), -1.0)}
    after, done = jax.jit(lambda states, key: restart(COUNTDOWN, states, key, group))(states, jax.random.key(0))
    np.testing.assert_array_equal(done, left == 0)
    np.testing.assert_array_equal(after["left"], np.where(left == 0, 3, left))
    np.testing.assert_array_equal(after["draw"][~done], -1.0)
    assert len(np.unique(after["draw"][done])) == 2 * 5  # each its own draw


def test_a_random_walk_counts_its_episodes():
    walk = environments.walk(COUNTDOWN, environments.Args(repeats=2, batches=(16,), at_least=0.0))
    assert walk.episode_length == pytest.approx(3, rel=0.01)
    assert list(walk.step) == [16]
    text = environments.tables({"ours": walk, "theirs": walk}, (16,))
    assert "| theirs | 1 |" in text


def test_a_script_writes_its_numbers_and_what_they_need_to_be_read(tmp_path):
    out = tmp_path / "new" / "capacity.json"
    command = [sys.executable, "-m", "experiments.benchmarks.capacity", "--quick", "--out", str(out)]
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert "| 10,000 |" in done.stdout
    content = json.loads(out.read_text())
    assert content["benchmark"] == "capacity"
    assert {"python", "packages", "device_kind", "cpu", "cores", "busy", "peers", "git_commit"} <= set(content["environment"])
    assert "out" not in content["settings"]
    for timing in content["results"]["per_step"].values():
        assert math.isfinite(sum(timing["seconds"]))


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (capacity.Args(capacities=()), "--capacities must be at least 1, got none"),
        (capacity.Args(chunk_steps=0), "--chunk-steps must be at least 1, got 0"),
        (capacity.Args(capacities=(5, -1)), "--capacities must be at least 1, got 5 -1"),
        (capacity.Args(repeats=0), "--repeats must be at least 1, got 0"),
    ],
)
def test_sizes_below_one_are_usage_errors(args, message):
    with pytest.raises(_measure.UsageError, match=message):
        _measure.check(args)


def test_a_wrong_number_of_cores_is_a_usage_error():
    with pytest.raises(_measure.UsageError, match="--cores"):
        _measure.pin(0)


def test_throughputs_are_compared_with_ours():
    ours = training_throughput.Throughput(_measure.Timing((0.01, 0.02, 0.05), 3.0), _measure.Timing((0.01,), 4.0))
    theirs = training_throughput.Throughput(_measure.Timing((0.1,), 0.5), _measure.Timing((0.05,), 0.5))
    text = training_throughput.table({"ours": ours, "theirs": theirs}, training_throughput.Args(cores=2))
    assert "| ours | 50 (20 to 100) | 1 | 100 (100 to 100) | 1 | 3.0 |" in text
    assert "| theirs | 10 (10 to 10) | 5 | 20 (20 to 20) | 5 | 0.5 |" in text


def test_q_learning_is_compared_with_ours():
    results = {"ours": _measure.Timing((0.01, 0.02, 0.05), 3.0), "theirs": _measure.Timing((0.1,), 0.0)}
    text = dqn_peers.table(results, updates=2)
    assert "| ours | 50 (20 to 100) | 1 | 3.0 |" in text
    assert "| theirs | 10 (10 to 10) | 5 | 0.0 |" in text


def test_q_learning_without_peers_says_what_is_missing(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["dqn_peers"])
    monkeypatch.setattr(dqn_peers.importlib.util, "find_spec", lambda name: None)
    assert dqn_peers.main() == 0
    assert "gymnax, rejax, stable_baselines3 not installed" in capsys.readouterr().out


def test_a_stretched_space_cuts_episodes_where_it_is_told_and_ignores_what_it_adds():
    space = Stretched(Corridor(), horizon=20, more=3)
    w = jax.jit(space.sample_uniform)(jax.random.key(0))
    assert {name: block.shape for name, block in w.items()} == {"goal": (1,), "paint": (4, 4, 2), "more": (3,)}
    assert space.instantiate({**w, "goal": jnp.array([4.5])}) == 4
    state, _ = space.reset(jax.random.key(1), jnp.int32(7))
    step = jax.jit(space.step)
    for count in range(1, 21):
        out = step(state, jnp.int32(0), jnp.int32(7))
        assert out.truncated == (count == 20)
        state = out.state


def test_growth_is_measured_tabulated_and_drawn(tmp_path, monkeypatch):
    """On the corridor, the usual run once for both axes."""
    loaded = []

    def load(point, quick):
        loaded.append(point)
        config = dataclasses.replace(CONFIG, method="dqn", replay_steps=100 * point.seeds)
        return _measure.Problem(Stretched(Corridor(), horizon=12, more=0), np.int32(7), config, HParams())

    monkeypatch.setattr(growth, "load_problem", load)
    args = growth.Args(repeats=2)
    sizes = {"seeds": (1, 2), "parameter": (growth.PARAMETER,)}
    costs = {axis: {size: growth.measure(growth.at(axis, size), args) for size in sizes[axis]} for axis in sizes}
    assert loaded == [growth.Point(), growth.Point(seeds=2)]
    assert costs["seeds"][2].state > costs["seeds"][1].state > 0
    assert "| 2 (2) | " in growth.tables(costs)
    growth.draw(tmp_path / "growth.png", costs)
    assert (tmp_path / "growth.png").stat().st_size > 0


def test_every_size_of_growth_fits_the_preset():
    for axis, sizes in growth.AXES.items():
        for size in sizes:
            problem = growth.load_problem(growth.at(axis, size), quick=True)
            make_trainer(problem.space, problem.config)


@pytest.fixture(scope="module")
def learn():
    """`learn(name)`: the parameters before and after an iteration's updates by a variant, on the same replay."""
    problem = _measure.Problem(Corridor(), np.int32(7), CONFIG, HParams())
    rings = variants.play(problem)

    @functools.cache
    def learn(name):
        variant = variants.VARIANTS[name]
        material = variants.make_material(problem, rings, widen=variant.widen)
        state = learner.init(material.network, jax.random.key(0))
        return state.params, jax.jit(variant.make(material))(state, rings, jax.random.key(1)).params

    return learn


@pytest.mark.parametrize("name", [name for name, variant in variants.VARIANTS.items() if not variant.flags])
def test_a_variant_of_the_policy_update_learns(name, learn):
    """What draws the same batches and has the same network ends up with the same parameters."""
    before, after = learn(name)
    assert not np.array_equal(*(jax.tree.leaves(params)[0] for params in (before, after)))
    if name not in ("each batch sampled by itself", "inputs padded to whole registers"):
        chex.assert_trees_all_close(after, learn(variants.FIRST)[1], atol=1e-6)


def test_a_variant_is_compared_turn_by_turn():
    first = _measure.Timing((1.0, 2.0, 4.0), 3.0)
    text = variants.table(
        {variants.FIRST: first, "xla_cpu_enable_fast_math=true": _measure.Timing((0.5, 2.0, 2.0), 1.0)}, updates=10
    )
    assert "| as it is | 200 (100 to 400) | 1.00 (1.00 to 1.00) | 3.0 |" in text
    assert "| `xla_cpu_enable_fast_math=true` | 200 (50 to 200) | 0.50 (0.50 to 1.00) | 1.0 |" in text


def test_every_benchmark_is_in_the_list_of_all():
    scripts = {path.stem for path in Path(variants.__file__).parent.glob("[a-z]*.py")}
    assert {script for script, *_ in everything.RUNS.values()} == scripts
    for script, *options in everything.RUNS.values():
        module = importlib.import_module(f"experiments.benchmarks.{script}")
        tyro.cli(module.Args, args=options)


@pytest.mark.parametrize(
    ("saved", "quick", "kept"),
    [
        ({}, False, True),
        ({}, True, False),
        ({"cpu": "another"}, False, False),
        ({"packages": {"jax": "1.0"}}, False, False),
        ({"peers": {"torch": None}}, False, False),
        ({"git_commit": "abc-dirty"}, False, False),
    ],
)
def test_only_what_was_measured_under_the_same_conditions_is_kept(tmp_path, saved, quick, kept):
    here = {"git_commit": "abc", "cpu": "one", "cores": 2, "packages": {"jax": "0.10.2"}, "peers": {"torch": "2.13"}}
    out = tmp_path / "seeds.json"
    assert not everything.is_measured(out, here, quick)
    out.write_text(json.dumps({"settings": {"quick": False}, "environment": here | saved | {"busy": 0.0}}))
    assert everything.is_measured(out, here, quick) == kept
    assert not everything.is_measured(out, here | {"git_commit": None}, quick)
    assert not everything.is_measured(out, {**here, **saved, "git_commit": "abc-dirty"}, quick)


def test_the_share_of_a_busy_machine_is_a_share():
    share = _measure.busy_share(0.01)
    assert math.isnan(share) or 0 <= share <= 1
