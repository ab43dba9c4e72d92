"""Programs that were kept do what they did; seeds that do not fit the devices' memory take turns, and nothing else changes."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from apt_jax.config import Config
from apt_jax.lanes import lane_bytes
from apt_jax.trainer import make_trainer
from experiments import runtime
from experiments.examples.corridor import Corridor
from experiments.programs import Programs
from experiments.runner import Runner
from experiments.settings import Experiment


@pytest.fixture(scope="module")
def experiment():
    """Five seeds of a run on the corridor, and its trainer."""
    config = Config(
        method="dqn",
        warmup_steps=40,
        updates_per_step=1,
        batch_size=4,
        replay_steps=60,
        replay_episodes=8,
        recent_steps=20,
        refresh_every=20,
        eval_every=20,
        eval_episodes=2,
        probe_tasks=2,
        return_window=8,
    )
    return Experiment(seeds=(3, 0, 4, 1, 2), config=config), make_trainer(Corridor(), config)


def start(experiment, trainer, programs=None, *, target=7):
    """A runner that is compiled, but has not run."""
    runner = Runner(trainer, np.int32(target), experiment, "map", programs=programs)
    runner.init()
    runner.compile()
    return runner


@pytest.fixture(scope="module")
def kept(experiment, tmp_path_factory):
    """A folder with the compiled programs of the run."""
    folder = tmp_path_factory.mktemp("programs")
    start(*experiment, Programs(folder))
    return folder


def test_seeds_that_do_not_fit_take_turns(experiment, kept, monkeypatch, tmp_path):
    """Two devices with room for two seeds each, against all at once; a checkpoint of one goes on in the other.

    Both ways a device loops over its seeds, so that XLA computes them alike, to the last bit.
    """
    together = start(*experiment, Programs(kept))
    assert together.programs.loaded == 3
    assert together.placement.startswith("5 lanes of 0.")
    monkeypatch.setattr(runtime, "device_memory", lambda: 4 * lane_bytes(experiment[1]))
    in_turns = start(*experiment)
    assert in_turns.placement.endswith("do not fit the devices' memory: 4 at a time take turns, the others wait in the host's")

    for runner in (together, in_turns):
        runner.warmup()
    expected, metrics = together.advance(), in_turns.advance()
    assert metrics.keys() == expected.keys()
    for name, values in metrics.items():
        np.testing.assert_array_equal(values, expected[name])

    in_turns.save(tmp_path / "checkpoints")
    expected = together.advance()
    for runner in (in_turns, together):
        runner.restore(tmp_path / "checkpoints")
        assert runner.env_steps == 60
        np.testing.assert_array_equal(runner.advance()["td_loss"], expected["td_loss"])
        assert all(leaf.shape[0] == 5 for leaf in jax.tree.leaves(runner.policies()))


def test_programs_serve_every_target(experiment, kept):
    """Loaded, they do for another target what ones that were just compiled do."""
    loading = start(*experiment, Programs(kept), target=3)
    assert (loading.programs.loaded, loading.programs.compiled) == (3, 0)
    compiled = start(*experiment, target=3)
    for runner in (loading, compiled):
        runner.warmup()
    expected = compiled.advance()
    for name, values in loading.advance().items():
        np.testing.assert_array_equal(values, expected[name])
    assert np.any(expected["behaviour_success"] > 0)
