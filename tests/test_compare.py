"""Comparisons: plans, resumption, and the aggregates in their tables."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from experiments import compare, report, train
from experiments.aggregates import iqm, iqm_interval
from experiments.compare import Compare
from experiments.errors import UsageError
from experiments.run_dir import RunDir

OPTIONS = ["--preset", "fast", "--seeds", "4", "2"]


def test_a_plan_has_a_run_per_method_and_target_and_goes_on_with_what_is_there(tmp_path):
    comparison = Compare(tmp_path, methods=("dqn", "apt_gen+rnd"), targets=("A", "B"))
    plan = compare.plan(comparison, OPTIONS)
    assert [session.run_dir for _, session in plan] == [
        tmp_path / target / method for target in "AB" for method in ("dqn", "apt_gen+rnd")
    ]
    assert [(experiment.target, experiment.config.method) for experiment, _ in plan][1:3] == [
        ("A", "apt_gen+rnd"),
        ("B", "dqn"),
    ]
    assert not any(session.resume for _, session in plan)
    train.open_run(RunDir(plan[1][1].run_dir), *plan[1])
    again = compare.plan(comparison, OPTIONS)
    assert [session.resume for _, session in again] == [False, True, False, False]
    assert [experiment for experiment, _ in again] == [experiment for experiment, _ in plan]
    with pytest.raises(UsageError, match="differs in seeds"):
        compare.plan(comparison, ["--preset", "fast", "--seeds", "7"])


def test_seeds_are_split_over_jobs_and_put_together_again(tmp_path):
    comparison = Compare(tmp_path, methods=("dqn",), seeds_per_job=2)
    runs = compare.plan(comparison, ["--preset", "fast", "--seeds", "4", "2", "9"])
    assert [experiment.seeds for experiment, _ in runs] == [(4, 2), (9,)]
    for experiment, session in runs:
        train.open_run(RunDir(session.run_dir), experiment, session)
        metrics = {name: np.float32(experiment.seeds) for name in ("target_return", "target_return_raw")}
        RunDir(session.run_dir).append_metrics(1_000, 0.5, [lane.index for lane in experiment.lanes], metrics)
    parts = compare.run_parts(comparison, "dqn", "A")
    curves = report.read_parts("dqn", parts)["dqn"][1]
    np.testing.assert_array_equal(curves["target_return"], [[4], [2], [9]])
    more = compare.plan(comparison, ["--preset", "fast", "--seeds", "4", "2", "9", "--env-steps", "200000"])
    assert [session.resume for _, session in more] == [True, True]
    with pytest.raises(UsageError, match=r"holds seeds_9, of other --seeds or --seeds-per-job"):
        compare.plan(comparison, ["--preset", "fast", "--seeds", "4", "2", "9", "5"])
    with pytest.raises(UsageError, match="runs of some seeds each; say --seeds-per-job"):
        compare.plan(dataclasses.replace(comparison, seeds_per_job=None), ["--preset", "fast", "--seeds", "4", "2", "9"])
    with pytest.raises(UsageError, match="not the seeds of one run"):
        report.read_parts("dqn", [*parts, parts[0]])


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"seeds_per_job": 0}, [], "--seeds-per-job must be at least 1, got 0"),
        ({"ray": True}, ["--distributed"], "--ray and --distributed exclude each other"),
        ({}, ["--run-dir", "x"], "--run-dir is decided for every run"),
        ({}, ["--config.method", "dqn"], "--config.method is decided"),
        ({"methods": ()}, [], "at least one name"),
        ({"targets": ("A", "A")}, [], "different names"),
    ],
)
def test_mistakes_are_told(tmp_path, changes, options, message):
    comparison = dataclasses.replace(Compare(tmp_path, methods=("dqn",)), **changes)
    with pytest.raises(UsageError, match=message):
        compare.plan(comparison, options)


def test_interquartile_mean_and_its_interval():
    values = np.array([0.0, 1.0, 2.0, 3.0, 100.0])
    assert iqm(values) == 2.0
    low, high = iqm_interval(values)
    assert 0.0 <= low < 2.0 < high <= 100.0
    assert iqm_interval(values) == (low, high)
    assert iqm_interval(np.full(5, 0.5)) == (0.5, 0.5)
    assert iqm_interval(np.array([0.25])) == (0.25, 0.25)


def test_a_summary_has_a_row_per_method_and_setting(tmp_path):
    comparison = Compare(tmp_path, methods=("dqn", "rnd"), targets=("A",))
    for method, value in (("dqn", 0.25), ("rnd", 0.95)):
        path = compare.run_path(comparison, method, "A")
        path.parent.mkdir(parents=True, exist_ok=True)
        run = RunDir(path)
        run.create({}, None)
        lanes = [{"seed": seed, "delta": delta} for delta in (0.1, 0.3) for seed in (0, 1)]
        metrics = {name: np.full(4, value, np.float32) for name in ("target_return", "target_return_raw")}
        run.append_metrics(1_000, 0.5, lanes, metrics)
    text = compare.summarise(comparison)
    rows = text.splitlines()
    assert rows[0] == "Target A:"
    assert rows[4] == "| dqn, delta 0.1 | 1,000 | 0.25 0.25 (0.25 ± 0.00) | 0.25 (0.25 to 0.25) | 0.25 0.25 | - - |"
    assert rows[7] == "| rnd, delta 0.3 | 1,000 | 0.95 0.95 (0.95 ± 0.00) | 0.95 (0.95 to 0.95) | 0.95 0.95 | 1k 1k |"
    assert len(report.HEADER) == rows[2].count("|") - 1
    assert (tmp_path / "comparison.md").read_text() == text + "\n"
    assert Path(tmp_path / "comparison.png").stat().st_size > 1_000
