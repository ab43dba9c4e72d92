"""Pictures are drawn from plain arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import envs
from experiments import plots, random_tasks
from experiments.errors import UsageError


def read(file: Path) -> np.ndarray:
    with Image.open(file) as image:
        return np.asarray(image)


def test_learning_curves_skip_metrics_a_method_lacks_and_go_on_in_a_second_row(tmp_path):
    env_steps = np.arange(1, 6) * 1000
    one = {"target_return": np.zeros((2, 5)), "td_loss": np.ones((2, 5))}
    gaps = np.where(env_steps > 3000, np.nan, 4.0) * np.ones((2, 1))
    four = one | {"generated_episode_return": gaps, "beta": np.ones((2, 5)), "probe_solution_length": gaps}
    sizes = []
    for name, curves in {"one": one, "four": four}.items():
        file = tmp_path / f"{name}.png"
        seeds = np.array([[0.0] * 5, [3.0] * 5])
        plots.learning_curves(file, {"": (env_steps, {**curves, "seed": seeds})}, delta=0.5, title=name)
        sizes.append(read(file).shape[:2])
    (low, narrow), (high, wide) = sizes
    assert wide == 3 * narrow
    assert 1.5 * low < high < 2 * low


def test_comparisons_have_a_panel_per_target_and_curves_a_colour_per_setting(tmp_path):
    run = (
        np.arange(1, 6) * 1000,
        {"target_return": np.linspace(0, 1, 10).reshape(2, 5), "seed": np.array([[0.0] * 5, [3.0] * 5])},
    )
    plots.comparison(tmp_path / "two.png", {"A": {"dqn": run, "rnd": run}, "B": {"rnd": run}})
    plots.comparison(tmp_path / "three.png", {name: {"dqn": run} for name in "ABC"})
    plots.comparison(tmp_path / "metrics.png", {"": {"dqn": run}}, metrics=("target_return", "beta", "seed"))
    assert read(tmp_path / "metrics.png").shape == read(tmp_path / "three.png").shape
    assert 2 * read(tmp_path / "three.png").shape[1] == 3 * read(tmp_path / "two.png").shape[1]
    plots.learning_curves(tmp_path / "sweep.png", {"delta 0.1": run, "delta 0.3": run}, delta=None, title="sweep")
    assert read(tmp_path / "sweep.png").std() > 0


@pytest.mark.parametrize("names", [["dqn"] * 2, ["manipulation_out_of_space_frozen_generator"] * 3, ["one", 60 * "w"]])
def test_a_legend_is_as_wide_as_the_figure_at_most(names):
    """However long the names are, unless one alone is wider."""
    run = (np.arange(1, 6) * 1000, {"target_return": np.zeros((2, 5))})
    runs = {name + str(index): run for index, name in enumerate(names)}
    figure = plots._together([("", runs, "target_return")], list(runs))
    figure.draw_without_rendering()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.x1


def test_many_runs_have_a_small_panel_each_where_they_have_the_metric(tmp_path):
    run = (np.arange(1, 6) * 1000, {"target_return": np.linspace(0, 1, 10).reshape(2, 5)})
    with_beta = (run[0], run[1] | {"beta": np.ones((2, 5))})
    many = {"apt_gen": with_beta} | {f"run {index}": run for index in range(plots.TOGETHER)}
    sizes = {}
    for metrics in (("target_return",), ("target_return", "beta")):
        plots.comparison(tmp_path / "many.png", {"A": many, "B": many}, metrics=metrics)
        sizes[metrics] = read(tmp_path / "many.png").shape
    (one, width, _), (two, same_width, _) = sizes.values()
    assert one < two < 2 * one, "beta takes one row of panels, the return two"
    assert width == same_width


def test_progression_and_gallery(tmp_path):
    board = np.full((40, 40, 3), 90, np.uint8)
    plots.progression(tmp_path / "p.png", {0: [board, board], 5000: [board, board]}, board, rows=["seed 0", "seed 1"])
    plots.gallery(tmp_path / "g.png", [board] * 5, columns=3)
    for name in ("p.png", "g.png"):
        assert read(tmp_path / name).std() > 0


@pytest.mark.parametrize(("count", "at_most", "chosen"), [(1, 6, [0]), (3, 6, [0, 10, 20]), (11, 3, [0, 50, 100])])
def test_evenly_keeps_first_and_last(count, at_most, chosen):
    assert plots.evenly([10 * i for i in range(count)], at_most) == chosen


def test_mosaic_has_a_column_per_step_and_a_row_per_task(tmp_path):
    board = np.full((40, 40, 3), 90, np.uint8)
    sizes = []
    for steps in (2, 6):
        plots.mosaic(tmp_path / "m.png", {1000 * step: [board] * 3 for step in range(steps)}, title="tasks")
        sizes.append(read(tmp_path / "m.png").shape)
    assert sizes[1][1] - sizes[0][1] == pytest.approx(4 * 44, abs=8)
    assert sizes[0][0] == sizes[1][0] > 3 * 40


def draw_random_tasks(monkeypatch, *options):
    monkeypatch.setattr("sys.argv", ["random_tasks", *options])
    monkeypatch.setattr("experiments.runtime.setup", lambda: None)
    return random_tasks.main()


def test_random_tasks_may_be_of_a_plug_in_space(tmp_path, monkeypatch):
    options = ["--out", str(tmp_path / "tasks.png"), "--space", "meadow", "--rows", "1", "--columns", "1"]
    monkeypatch.setattr(envs, "SPACES", dict(envs.SPACES))
    with pytest.raises(UsageError, match="unknown task space 'meadow'"):
        draw_random_tasks(monkeypatch, *options)
    (tmp_path / "meadows.py").write_text("import envs\n\nenvs.SPACES['meadow'] = envs.SPACES['grid_world']\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert draw_random_tasks(monkeypatch, *options, "--plugins", "meadows") == 0


def test_random_tasks_differ_by_seed_alone(tmp_path, monkeypatch):
    files = [tmp_path / name for name in ("a.png", "b.png", "c.png")]
    for file, seed in zip(files, (0, 0, 1), strict=True):
        assert draw_random_tasks(monkeypatch, "--out", str(file), "--rows", "1", "--columns", "2", "--seed", str(seed)) == 0
    first, again, other = map(read, files)
    np.testing.assert_array_equal(first, again)
    assert first.shape == other.shape
    assert (first != other).any()


@pytest.mark.parametrize("options", [("--rows", "0"), ("--columns", "-1"), ("--space", "chess")])
def test_random_tasks_say_what_is_wrong(options, tmp_path, monkeypatch):
    with pytest.raises(UsageError, match=r"at least 1|chess"):
        draw_random_tasks(monkeypatch, "--out", str(tmp_path / "tasks.png"), *options)
