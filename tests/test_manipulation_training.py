"""The whole trainer on Manipulation, through the protocol alone."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import envs
from apt_jax.config import PRESETS, Config, HParams
from apt_jax.trainer import Clock, make_trainer
from tests.tables import SPACE

CONFIG = Config(
    envs_per_source=2,
    warmup_steps=60,
    updates_per_step=1,
    batch_size=8,
    replay_steps=100,
    replay_episodes=16,
    model_updates_per_step=0.25,
    model_batch_size=4,
    recent_steps=60,
    refresh_every=4,
    eval_every=8,
    eval_episodes=2,
    probe_tasks=2,
    return_window=4,
)
UNDEFINED = {"probe_goal_way", "probe_can_distance"}
"""Metrics that are NaN if no proposed task has the cans they are about."""


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("target", SPACE.targets)
def test_every_preset_makes_a_trainer_for_every_target(preset, target):
    make_trainer(SPACE, envs.load_target("manipulation", target), PRESETS[preset][0])


def test_two_chunks_of_apt_gen():
    trainer = make_trainer(SPACE, envs.load_target("manipulation", "out_of_space"), CONFIG)
    hparams = HParams()
    state = jax.jit(trainer.init)(jax.random.key(0), hparams)
    state, clock = jax.jit(trainer.warmup)(state, Clock.start(), hparams)
    chunk = jax.jit(trainer.chunk)
    for _ in range(2):
        state, clock, metrics = chunk(state, clock, hparams)
        for name, value in metrics.items():
            assert np.isfinite(value) or name in UNDEFINED, name
        assert 0 <= metrics["probe_pits"] + metrics["probe_roadblocks"] <= 1
    assert clock.env_steps == 76
    assert chunk._cache_size() == 1
    obs = state.workers.obs["positions"]
    assert np.isfinite(obs).all()
    assert (np.asarray(obs[0]) != -1).all(), "the target's cans are all there"
