"""The tests of one set of runs against another, beside numbers worked out by counting."""

from __future__ import annotations

import json
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from experiments import contrast, document
from experiments.errors import UsageError
from experiments.run_dir import RunDir

RESULTS = Path(__file__).parents[1] / "experiments/results"
NEVER = np.inf


def counted(first, second):
    """The share of all deals whose sum of ranks is as far out on its side, doubled: twice the smaller of both."""
    pooled = np.concatenate([first, second])
    ranks = [np.sum(pooled < x) + (np.sum(pooled == x) + 1) / 2 for x in pooled]
    sums = np.array([sum(ranks[i] for i in deal) for deal in combinations(range(pooled.size), first.size)])
    own = sum(ranks[: first.size])
    return min(1.0, 2 * min(np.mean(sums <= own), np.mean(sums >= own)))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ([1, 2, 3], [4, 5, 6]),
        ([4, 5, 6], [1, 2, 3]),
        ([43, 29, 90, 46, NEVER], [NEVER, 85, NEVER, 95, 95]),
        ([1, 1], [1, 1, 1]),
    ],
)
def test_sooner_is_counted_over_all_deals_and_ties_share_their_rank(first, second):
    first, second = np.array(first, float), np.array(second, float)
    assert contrast.p_sooner(first, second) == pytest.approx(counted(first, second), abs=1e-12)


def test_solved_is_fishers_exact_test():
    """Five of five against none: the two ends of the 252 ways to choose five of ten."""
    assert contrast.p_solved(np.arange(5.0), np.full(5, NEVER)) == pytest.approx(2 / 252)
    assert contrast.p_solved(np.full(4, NEVER), np.full(5, NEVER)) == 1.0


def test_what_comes_later_or_never_does_not_count():
    steps = np.array([1_000, 2_000, 3_000])
    curves = {"target_return_raw": np.array([[0.0, 0.95, 0.0], [0.0, 0.0, 0.95], [0.0, 0.9, 0.9]])}
    np.testing.assert_array_equal(contrast.solving_times([(steps, curves)], until=2_000), [2_000, NEVER, NEVER])
    np.testing.assert_array_equal(contrast.solving_times([(steps, curves)] * 2, until=3_000), [2_000, 3_000, NEVER] * 2)


def test_a_run_that_was_stopped_with_a_seed_unsolved_is_named():
    first, second = RESULTS / "grid_world_B_return_only", RESULTS / "grid_world_B_dqn"
    with pytest.raises(UsageError, match=r"70000 is more than .*grid_world_B_return_only has made with a seed unsolved: 60000"):
        contrast.cells([first], [second], 70_000)
    assert contrast.cells([first], [second])[2:4] == ("60,000", "4 of 5 and 0 of 5")


def test_a_run_that_was_stopped_with_all_seeds_solved_has_come_far_enough():
    solved, other = RESULTS / "grid_world_C_progress_only", RESULTS / "grid_world_C_dqn"
    assert contrast.cells([solved], [other], 100_000)[2:4] == ("100,000", "5 of 5 and 2 of 5")


def copy(run, to, **changes):
    """A run directory under another name, with a changed configuration."""
    to.mkdir(parents=True)
    (to / "metrics.csv").write_bytes((run / "metrics.csv").read_bytes())
    config = json.loads((run / "config.json").read_text())
    (to / "config.json").write_text(json.dumps(config | changes))
    return to


def test_runs_of_one_name_are_told_apart(tmp_path):
    """As `experiments.compare` names them: by their method, in a folder of the target's."""
    first = copy(RESULTS / "grid_world_B_apt_gen_20", tmp_path / "one" / "run")
    second = copy(RESULTS / "grid_world_B_random_20", tmp_path / "other" / "run")
    assert contrast.cells([first], [second], 100_000)[:4] == ("run", "run", "100,000", "3 of 5 and 0 of 5")
    with pytest.raises(UsageError, match=r"120000 is more than .*other/run has made"):
        contrast.cells([first], [second], 120_000)


def test_what_cannot_be_compared_is_refused(tmp_path):
    run, other = RESULTS / "grid_world_B_apt_gen_20", RESULTS / "grid_world_B_random_20"
    twice = copy(run, tmp_path / "copy", env_steps=100_000)
    on_c = RESULTS / "grid_world_C_random_20"
    for first, second, message in (
        ([run, twice], [other], "the same seed of the same run is there twice"),
        ([run], [on_c], "the same targets, got B of grid_world beside C of grid_world"),
        ([], [other], "at least one directory each"),
    ):
        with pytest.raises(UsageError, match=message):
            contrast.cells(first, second)
    with pytest.raises(UsageError, match="--env-steps must be at least 1, got -5"):
        contrast.cells([run], [other], -5)


def test_a_sweep_is_refused(tmp_path):
    run = RunDir(tmp_path / "sweep")
    run.create({"space": "grid_world", "target": "B", "seeds": [0]}, None)
    lanes = [{"seed": 0, "gamma": gamma} for gamma in (0.9, 0.99)]
    run.append_metrics(1_000, 0.0, lanes, {"target_return_raw": np.zeros(2)})
    with pytest.raises(UsageError, match="sweep is a sweep of 2 settings"):
        contrast.cells([run.path], [RESULTS / "grid_world_B_random_20"])


def test_the_command_line_prints_the_table(monkeypatch, capsys):
    runs = [str(RESULTS / f"grid_world_B_{name}_20") for name in ("apt_gen", "random")]
    monkeypatch.setattr(sys, "argv", ["contrast", "--first", runs[0], "--second", runs[1], "--env-steps", "100000"])
    assert contrast.main() == 0
    assert (
        "| grid_world_B_apt_gen_20 | grid_world_B_random_20 | 100,000 | 3 of 5 and 0 of 5 | 0.17 |" in capsys.readouterr().out
    )
    monkeypatch.setattr(sys, "argv", ["contrast", "--first", "--second", runs[1]])
    with pytest.raises(UsageError, match="at least one directory each"):
        contrast.main()


@pytest.mark.parametrize("mark", ["100000", "grid_world_B_apt_gen_20:grid_world_B_random_20", "100000 grid_world_B_apt_gen_20"])
def test_a_contrast_in_a_document_that_cannot_be_read_says_how_it_reads(mark):
    with pytest.raises(UsageError, match="a contrast reads STEPS"):
        document.fill(f"<!-- table: contrast {mark} -->\n{document.END}\n", RESULTS)
