"""Which tasks count as fresh, what is measured of them, and how they are summed up."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apt_jax.config import Config, HParams
from apt_jax.curricula.base import GENERATED
from apt_jax.lanes import Program, stack_hparams
from apt_jax.replay import Episode
from apt_jax.trainer import Clock, make_trainer
from experiments import command_line, foresight, train
from experiments.errors import UsageError
from experiments.examples.corridor import Corridor
from experiments.run_dir import RunDir


def test_episodes_count_if_any_length_would_have_fitted():
    # Iterations 100 to 199, of which episodes of at most 50 steps that begin by 150 see the end.
    began = jnp.array([99, 100, 100, 150, 151, 149, np.iinfo(np.int32).min])
    length = jnp.array([10, 1, 50, 50, 2, 1, 1])
    n = began.shape[0]
    nothing = jnp.zeros(n)
    episodes = Episode({}, nothing.astype(int), began + length - 1, length, nothing, nothing.astype(bool))
    fresh = foresight.played_within(episodes, jnp.int32(100), jnp.int32(200), 50)
    assert fresh.tolist() == [False, True, True, True, False, True, False]


@pytest.mark.relaxed("keys")  # both policies play under the same randomness, as they should
def test_v2_is_asked_before_the_tasks_are_played(monkeypatch):
    """One period on the corridor, where training is a function that writes known episodes and forgets all it knew."""
    sizes = {"envs_per_source": 1, "replay_steps": 60, "recent_steps": 40, "replay_episodes": 8, "return_window": 8}
    config = Config(method="apt_gen", value_ensemble=2, **sizes)
    trainer = make_trainer(Corridor(), config)
    lanes = stack_hparams([HParams(pessimism=0.0, epsilon_end=0.0), HParams(pessimism=1.0, epsilon_end=0.0)])
    states = jax.jit(jax.vmap(trainer.init))(jax.random.split(jax.random.key(0), 2), np.full(2, 7, np.int32), lanes)
    models = states.curriculum.models
    says = jnp.tile(jnp.array([0.25, 0.75]), (2, 1))[..., None]  # each network of each lane the same of every task
    models = models._replace(return_value=constant(models.return_value, says))
    policy, goes = states.learner, jnp.tile(jnp.array([[1.0, 0.0], [0.0, 1.0]])[:, None], (1, 2, 1))  # left, right
    policy = policy._replace(params=constant(policy.params, goes[0]), target_params=constant(policy.target_params, goes[1]))
    states = states._replace(learner=policy, curriculum=states.curriculum._replace(models=models))

    def chunk(states, clock, hparams):
        del hparams
        rings = states.replay.episodes
        length, after = jnp.array([2, 3, 12, 1]), clock.iteration + 40
        end = clock.iteration + jnp.array([0, 3, 20, 39])  # the first began too early, the last too late
        rings = rings._replace(
            end=rings.end.at[:, GENERATED, :4].set(end),
            length=rings.length.at[:, GENERATED, :4].set(length),
            episode_return=rings.episode_return.at[:, GENERATED, :4].set(jnp.array([5.0, 0.9, -0.1, 5.0])),
        )
        models = jax.tree.map(jnp.zeros_like, states.curriculum.models)
        states = states._replace(curriculum=states.curriculum._replace(models=models))
        return states._replace(replay=states.replay._replace(episodes=rings)), Clock(after, clock.env_steps + 80), {}

    monkeypatch.setattr(foresight, "make_program", lambda *_, **__: Program(None, None, chunk))
    clock = Clock(jnp.int32(200), jnp.int32(400))
    _, after, seen = foresight.period(trainer, states, clock, lanes, 16, jax.random.key(1))
    assert after.env_steps == 480
    np.testing.assert_array_equal(seen.played, [2, 2])
    np.testing.assert_allclose(seen.training, 0.4, rtol=1e-6)
    np.testing.assert_allclose(seen.mean, 0.5, rtol=1e-6)
    np.testing.assert_allclose(seen.value, [0.5, 0.25], rtol=1e-5)
    np.testing.assert_allclose(seen.online, -0.01 * Corridor.horizon, rtol=1e-5)
    assert np.all(seen.averaged > 0.9)


def constant(params, output):
    """Parameters of a network that says `output` whatever it sees."""
    params = jax.tree.map(jnp.zeros_like, params)
    params["params"]["head"]["output"]["bias"] = jnp.asarray(output)
    return params


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
    experiment, session = command_line.parse(["--run-dir", str(tmp_path), "--method", "random"])
    train.open_run(RunDir(session.run_dir), experiment, session)
    monkeypatch.setattr("sys.argv", ["foresight", "--run-dir", str(tmp_path)])
    monkeypatch.setattr("experiments.runtime.setup", lambda: None)
    with pytest.raises(UsageError, match="is no run of apt_gen but of random"):
        foresight.main()
