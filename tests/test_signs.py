"""The table of a curriculum's signs against numbers worked out by hand."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from apt_jax.config import HParams
from experiments import report, run_dir, signs
from experiments.errors import PICTURES, UsageError, check_output

ROOT = Path(__file__).parents[1]


def test_over_time_takes_the_mean_of_the_five_values_up_to_each_quarter_and_skips_gaps():
    values = np.arange(40.0)
    values[39] = np.nan
    assert signs.over_time(np.arange(1, 41), values, 2) == "7.00 17.00 27.00 36.50"
    assert signs.over_time(np.arange(1, 9), np.full(8, np.nan), 1) == "- - - -"
    assert signs.over_time(np.arange(1, 9), None, 1) == "-"


def test_a_row_averages_what_lies_after_the_given_step():
    env_steps = np.arange(1, 9) * 1_000
    late = env_steps > 4_000
    curves = {
        "generated_episode_return": np.where(late, 0.5, -9.0),
        "beta": np.array([8.0, 8.0, 8.0, 8.0, 8.0, 0.125, 0.125, 1.0]),
        "v1_correlation": np.where(late, 0.25, 9.0),
        "v2_correlation": np.where(late, -0.5, 9.0),
        "v2_bias": np.where(late, 0.1, 9.0),
        "generator_return": np.where(late, 0.25, 9.0),
    }
    cells = signs.cells("run", "3", env_steps, curves, 4_000, HParams(beta_min=0.125, beta_max=8.0))
    assert cells[:4] == ("run", "3", "0.50 (0.50 to 0.50)", "50%, 25%")
    assert cells[4:] == ("-", "-", "-", "-", "0.25", "-0.50", "+0.10", "-0.25 (0.25; nan)")


def test_what_signs_cannot_read_is_named(tmp_path):
    goal_gan = ROOT / "experiments/results/methods_A/goal_gan"
    for path, words in ((goal_gan, "goal_gan is a run of goal_gan: signs reads"), (tmp_path / "none", "none holds no run")):
        with pytest.raises(UsageError, match=words):
            signs.table([path])
    with pytest.raises(UsageError, match="none is no directory"):
        run_dir.read_metrics(tmp_path / "none")


def test_runs_of_one_name_are_not_mixed_up(tmp_path):
    with pytest.raises(UsageError, match="must differ: apt_gen"):
        report.read([tmp_path / "A" / "apt_gen", tmp_path / "B" / "apt_gen"])


def test_error_has_a_mean_a_size_and_a_correlation_and_skips_gaps():
    assert signs.error(np.array([0.6, 0.4, 9.0]), np.array([0.2, 0.6, np.nan])) == "+0.10 (0.32; -1.00)"


@pytest.mark.parametrize("module", [signs, report])
def test_no_run_is_a_mistake(module, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["module", "--runs"])
    with pytest.raises(UsageError, match="--runs needs at least one directory"):
        module.main()


def test_folders_are_made_and_where_nothing_can_be_written_is_told(tmp_path):
    check_output(None, PICTURES)
    check_output(tmp_path / "new" / "deep" / "picture.png", PICTURES)
    assert (tmp_path / "new" / "deep").is_dir()
    (tmp_path / "file").touch()
    for name, message in (
        ("file/picture.png", "file is no directory"),
        ("new", "new is a directory; name the file to write"),
        ("film.mp4", "film.mp4 must end in .png or .pdf"),
        ("film", "film must end in"),
    ):
        with pytest.raises(UsageError, match=message):
            check_output(tmp_path / name, PICTURES)
