"""What a run tells about itself while it trains."""

from __future__ import annotations

import io

import numpy as np
from rich.console import Console

from experiments import progress

METRICS = {"target_return": np.array([0.25, 0.75]), "beta": np.array([8.0, 0.125]), "td_loss": np.array([0.1, 0.2])}


def test_a_terminal_shows_every_lane_and_notes_stay():
    screen = io.StringIO()
    with progress.LiveView(["seed 0", "seed 5"], 1000, Console(file=screen, force_terminal=True, width=120)) as view:
        view.note("compiled in 1.0 s")
        view.start(100)
        view.write(600, METRICS)
        view.stop()
        view.note("after the last picture")
    text = screen.getvalue()
    for part in ("compiled in 1.0 s", "600/1000", "steps/s", "seed 0", "seed 5", "target return", "0.250", "8.000", "0.125"):
        assert part in text
    assert "generated return" not in text  # this method has none
    assert text.rstrip().endswith("after the last picture")


def test_brackets_in_a_note_are_no_markup_and_a_lane_without_a_value_is_left_out_of_the_mean():
    screen = io.StringIO()
    with progress.LiveView(["seed 0", "seed 5"], 1000, Console(file=screen, force_terminal=True, width=120)) as view:
        view.note("into runs/A[fast]")
        view.start(100)
        view.write(600, {"generated_episode_return": np.array([np.nan, 0.625])})
    assert "into runs/A[fast]" in screen.getvalue()
    assert screen.getvalue().count("0.625") == 2


def test_a_log_gets_one_line_an_evaluation(capsys):
    with progress.PlainView(1000) as view:
        view.start(0)
        view.write(500, METRICS)
    assert capsys.readouterr().out.count("\n") == 1


def test_the_pace_counts_from_where_the_run_went_on(monkeypatch):
    now = iter([10.0, 10.0, 20.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    pace = progress.Pace(400, 1400)
    assert pace.describe(400) == "starting"
    assert pace.describe(900) == "50 steps/s, 0:00:10 left"
