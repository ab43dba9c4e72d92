"""The hand-made curriculum that learned ones are measured against."""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from apt_jax import replay as rp
from apt_jax.config import Config, HParams
from apt_jax.curricula import CURRICULA
from envs.grid_world.placement import parameter, place
from envs.grid_world.solver import solve
from experiments import command_line, ladder, settings, train
from experiments.examples.corridor import Corridor
from experiments.problem import make_problem
from experiments.run_dir import RunDir

SPACE = envs.make("grid_world")
PLUGIN = "experiments.ladder_methods"


@pytest.fixture(scope="module")
def climbing():
    """The curriculum and the ladder of B."""
    return ladder.make(SPACE, Config(), target="B"), ladder.build(envs.load_target("grid_world", "B"))


@pytest.mark.parametrize("name", ["A", "B", "C"])
def test_a_target_is_made_of_its_parameter(name):
    target = envs.load_target("grid_world", name)
    jax.tree.map(np.testing.assert_array_equal, place(parameter(target)), target)


def test_there_is_no_ladder_in_another_space():
    with pytest.raises(ValueError, match="grid_world, not for corridor"):
        ladder.make(Corridor(), Config(), target="A")


def test_a_plug_in_adds_its_methods_to_a_run_and_is_remembered_by_it(tmp_path, monkeypatch):
    for name in ("ladder_A", "ladder_B", "ladder_C"):  # it is as it was afterwards
        monkeypatch.setitem(CURRICULA, name, None)
    monkeypatch.delitem(sys.modules, PLUGIN, raising=False)
    options = ["--plugins", PLUGIN, "--method", "ladder_C", "--target", "C"]
    experiment, session = command_line.parse(["--run-dir", str(tmp_path), *options])
    make_problem(experiment)
    train.open_run(RunDir(session.run_dir), experiment, session)
    assert settings.load(tmp_path) == experiment
    assert command_line.parse(["--run-dir", str(tmp_path), "--resume"])[0].plugins == (PLUGIN,)


def test_rungs_lead_from_one_step_to_the_target(climbing):
    _, rungs = climbing
    assert rungs.steps[0] == 1
    assert rungs.steps[-1] == 36
    assert np.all(np.diff(rungs.steps) <= 2), "no rung is out of reach of the one before"
    for rung in (0, 10, len(rungs.steps) - 1):
        task = place(jax.tree.map(lambda x, at=rungs.first[rung]: x[at], rungs.w))
        assert len(solve(task)) == rungs.steps[rung]


def played(w, success):
    """A replay whose generated source has finished these episodes."""
    rings = rp.init(SPACE.obs_spec, SPACE.param_spec, sources=2, envs=1, columns=100, episodes=64)
    n = len(success)
    episodes = rings.episodes._replace(
        w=jax.tree.map(lambda ring, x: ring.at[1, :n].set(x), rings.episodes.w, w),
        success=rings.episodes.success.at[1, :n].set(jnp.array(success)),
    )
    return rings._replace(episodes=episodes, finished=jnp.array([0, n], jnp.int32))


@pytest.mark.parametrize(("solved", "of", "climbs"), [(6, 10, True), (5, 10, False), (9, 9, False), (0, 0, False)])
def test_the_next_rung_is_climbed_where_the_latest_tasks_of_this_one_are_solved(climbing, solved, of, climbs):
    """Easier tasks, all of them solved, count for nothing."""
    curriculum, rungs = climbing
    index = np.array([rungs.first[3]] * of + [rungs.first[1]] * 20)
    w = jax.tree.map(lambda x: x[index], rungs.w)
    success = [True] * solved + [False] * (of - solved) + [True] * 20
    after = curriculum.refresh(jnp.int32(3), jax.random.key(0), played(w, success), jnp.int32(0), HParams())
    assert after == 3 + climbs


def test_half_of_the_tasks_are_at_the_frontier_and_none_beyond(climbing):
    curriculum, rungs = climbing
    w = curriculum.propose(jnp.int32(4), jax.random.key(0), 400, HParams())
    steps = np.asarray(jax.vmap(lambda w: SPACE.describe(place(w), place(w))["solution_length"])(w))
    assert steps.max() == rungs.steps[4]
    np.testing.assert_allclose(np.mean(steps == rungs.steps[4]), 0.6, atol=0.08)
