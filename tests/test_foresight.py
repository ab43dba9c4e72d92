"""Which tasks count as fresh, and how they are summed up."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax.replay import Episode
from experiments import foresight, settings, train
from experiments.errors import UsageError


def test_episodes_count_if_any_length_would_have_fitted():
    # Iterations 100 to 199, of which episodes of at most 50 steps that begin by 150 see the end.
    began = jnp.array([99, 100, 100, 150, 151, 149, np.iinfo(np.int32).min])
    length = jnp.array([10, 1, 50, 50, 2, 1, 1])
    n = began.shape[0]
    nothing = jnp.zeros(n)
    episodes = Episode({}, nothing.astype(int), began + length - 1, length, nothing, nothing.astype(bool))
    fresh = foresight.played_within(episodes, jnp.int32(100), jnp.int32(200), 50)
    assert fresh.tolist() == [False, True, True, True, False, True, False]


def test_periods_weigh_by_the_tasks_played():
    played = np.array([[1.0, 0.0], [3.0, 2.0]])
    value = np.array([[0.0, np.nan], [1.0, 0.5]])
    line = np.array([[0.2, 0.4], [0.4, 0.4]])
    seen = foresight.Foresight(played, value, value, value, line, line)
    rows = foresight.table(["seed 0", "seed 1"], seen).splitlines()[2:]
    nothing = foresight.Foresight(0 * played, value, value, value, line, line)
    assert foresight.table(["seed 0"], nothing).splitlines()[2] == "| seed 0 | 0 | nan | nan | nan | 0.30 | 0.30 |"
    assert rows == ["| seed 0 | 4 | 0.75 | 0.75 | 0.75 | 0.30 | 0.30 |", "| seed 1 | 2 | 0.50 | 0.50 | 0.50 | 0.40 | 0.40 |"]


def test_only_apt_gen_has_v2(tmp_path, monkeypatch):
    experiment, session = settings.parse(["--run-dir", str(tmp_path), "--method", "random"])
    train.open_run(experiment, session)
    monkeypatch.setattr("sys.argv", ["foresight", "--run-dir", str(tmp_path)])
    monkeypatch.setattr("experiments.runtime.setup", lambda: None)
    with pytest.raises(UsageError, match="is no run of apt_gen but of random"):
        foresight.main()
