"""The PyTorch loop that ours is timed against computes what ours computes: losses, gradients, an update, samples.

Both sides get the same weights and the same experience, collected at random on the target and on a fresh generator's tasks.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

torch = pytest.importorskip("torch")

import envs
from apt_jax import learner, replay
from apt_jax.config import PRESETS, Config, HParams
from apt_jax.curricula import apt_gen
from apt_jax.curricula.apt_gen_objectives import Objectives, make_objectives, task_progress
from apt_jax.curricula.base import GENERATED, TARGET
from apt_jax.networks import QNetwork
from apt_jax.trainer import Clock, TrainState, make_trainer
from envs.grid_world.dynamics import HORIZON
from experiments.benchmarks import _measure, _torch_apt_gen, _torch_models, _torch_policy, _torch_replay
from tests import torch_weights

SPACE = envs.make("grid_world")
NETWORK = QNetwork(SPACE.obs_spec, SPACE.num_actions)
LOW, HIGH = -0.05, 0.05
"""Bounds of the next-Q clip, narrow enough that it matters."""

TOLERANCE = 1e-5
"""Largest difference, as a share of an array's largest number."""

ROUNDING = 1e-7
"""Largest difference besides: of a number in which others around one have cancelled."""


@dataclasses.dataclass
class Sides:
    """Ours after its warm-up, with the latest iteration written, and PyTorch's with the same weights."""

    config: Config
    hparams: HParams
    state: TrainState
    iteration: jax.Array
    objectives: Objectives
    policy: _torch_policy.Policy
    models: _torch_models.Models


@pytest.fixture(scope="module", params=[("paper", False), ("fast", True)], ids=["paper", "fast"])
def sides(request):
    """A preset without `judge_parts`, and one with it."""
    preset, judge_parts = request.param
    config, hparams = PRESETS[preset]
    sizes = {"warmup_steps": 1_000, "replay_steps": 2_000, "recent_steps": 500, "model_batch_size": 32}
    config = dataclasses.replace(config, judge_parts=judge_parts, **sizes)
    trainer = make_trainer(SPACE, config)
    state = jax.jit(trainer.init)(jax.random.key(0), envs.load_target("grid_world", "A"), hparams)
    state, clock = jax.jit(trainer.warmup)(state, Clock.start(), hparams)
    # An average network of its own shows which of the two is asked for what, and marked episodes which are drawn.
    average = learner.init(NETWORK, jax.random.key(1)).params
    marked = state.replay.episodes._replace(success=state.replay.episodes.end % 3 == 0)
    state = state._replace(learner=state.learner._replace(target_params=average), replay=state.replay._replace(episodes=marked))

    policy, models = _torch_policy.Policy(hparams), _torch_models.Models(config, hparams)
    torch_weights.load(policy.online, torch_weights.q_network(policy.online, state.learner.params))
    torch_weights.load(policy.average, torch_weights.q_network(policy.average, average))
    ours = state.curriculum.models
    torch_weights.load(models.generator, torch_weights.generator(models.generator, ours.generator))
    torch_weights.copy(torch_weights.statistics(models.generator, state.curriculum.batch_stats))
    torch_weights.load(models.discriminator, torch_weights.discriminator(models.discriminator, ours.discriminator))
    if math.isfinite(hparams.spectral_bound):
        torch_weights.copy(torch_weights.singular_vectors(models.discriminator, state.curriculum.spectral))
    for modules, params in zip(models.values, (ours.progress_value, ours.return_value), strict=True):
        torch_weights.load(modules, torch_weights.ensemble(modules, params))
    return Sides(config, hparams, state, clock.iteration - 1, make_objectives(SPACE, config), policy, models)


def tensors(tree):
    """Arrays as tensors, small whole numbers as those that PyTorch indexes with."""

    def tensor(x):
        x = torch.from_numpy(np.array(x))
        return x if x.is_floating_point() else x.long()

    return jax.tree.map(tensor, tree)


def assert_close(theirs, ours):
    theirs, ours = (np.asarray(x.detach() if isinstance(x, torch.Tensor) else x) for x in (theirs, ours))
    assert theirs.shape == ours.shape
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=TOLERANCE * np.abs(ours).max() + ROUNDING)


def assert_gradients_close(pairs):
    for parameter, gradient in pairs:
        assert_close(parameter.grad, gradient)


def batch_of(sides):
    """The same transitions for both."""
    config, hparams = sides.config, sides.hparams
    batches = replay.sample_transitions(
        sides.state.replay,
        jax.random.key(2),
        sides.iteration,
        batches=1,
        batch_size=config.batch_size,
        n_step=1,
        gamma=hparams.gamma,
        success_share=config.success_share,
        horizon=HORIZON,
    )
    batch = jax.tree.map(lambda x: x[0], batches)
    theirs = _torch_replay.Batch(*tensors((batch.obs, batch.action, batch.reward, batch.next_obs, batch.discount)))
    return batch, theirs


def rollouts_of(sides, source):
    """The same rollouts for both."""
    config = sides.config
    ours = replay.sample_rollouts(
        sides.state.replay,
        jax.random.key(3 + source),
        sides.iteration,
        source=source,
        batch_size=config.model_batch_size,
        steps=config.rollout_steps,
        recent=config.recent_steps // config.envs_per_source,
        recency=1.0,
    )
    steps = ours.steps
    theirs = tensors(
        (ours.w, ours.initial_obs, steps.obs, steps.action, steps.reward, steps.next_obs, ours.length, ours.episode_return)
    )
    return ours, _torch_replay.Rollouts(*theirs)


def test_a_policy_update_is_the_same(sides):
    hparams, policy = sides.hparams, sides.policy
    ours, theirs = batch_of(sides)
    # In the midst of training: Adam's very first steps have the size of the rate whatever the gradient's.
    moments = sides.state.learner.opt_state
    moments = moments._replace(count=jnp.int32(10), nu=jnp.full_like(moments.nu, 1e-4))
    for parameter in policy.online.parameters():
        policy.optimizer.state[parameter] = {
            "step": torch.tensor(10.0),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.full_like(parameter, 1e-4),
        }

    @jax.jit
    def update(state, batch):
        return learner.update(NETWORK, state, batch, low=jnp.float32(LOW), high=jnp.float32(HIGH), hparams=hparams)

    state, metrics = update(sides.state.learner._replace(opt_state=moments), ours)
    before = [parameter.detach().clone() for parameter in policy.online.parameters()]
    with torch.no_grad():
        assert_close(policy.loss(theirs, torch.tensor(LOW), torch.tensor(HIGH)), metrics["td_loss"])
    policy.update(theirs, LOW, HIGH)
    assert all((old != new).any() for old, new in zip(before, policy.online.parameters(), strict=True))
    # Adam's first moment was zero: it is a tenth of the gradient now.
    unravel = ravel_pytree(state.params)[1]
    assert_gradients_close(torch_weights.q_network(policy.online, unravel(10.0 * state.opt_state.mu)))
    for module, params in ((policy.online, state.params), (policy.average, state.target_params)):
        for parameter, value in torch_weights.q_network(module, params):
            assert_close(parameter, value)


def test_the_clip_of_the_next_value_matters(sides):
    _, theirs = batch_of(sides)
    with torch.no_grad():
        losses = {sides.policy.loss(theirs, torch.tensor(-bound), torch.tensor(bound)).item() for bound in (HIGH, 10.0)}
    assert len(losses) == 2


def test_the_discriminator_is_the_same(sides):
    hparams, models = sides.hparams, sides.models
    (target, their_target), (generated, their_generated) = (rollouts_of(sides, source) for source in (TARGET, GENERATED))

    def loss(params):
        return sides.objectives.discriminator_loss(params, sides.state.curriculum.spectral, target, generated, hparams)

    differentiate = jax.jit(jax.value_and_grad(loss, has_aux=True))
    (ours, ((_, logit), spectral)), gradient = differentiate(sides.state.curriculum.models.discriminator)
    theirs, their_logit = models.discriminator_loss(their_target, their_generated)
    theirs.backward()
    assert_close(theirs, ours)
    assert_close(their_logit, logit)
    assert_gradients_close(torch_weights.discriminator(models.discriminator, gradient))
    if math.isfinite(hparams.spectral_bound):
        for vector, moved in torch_weights.singular_vectors(models.discriminator, spectral):
            assert_close(vector, moved)
    progress = task_progress(logit, relative=sides.config.relative_progress)
    assert_close(_torch_models.task_progress(tensors(logit), relative=sides.config.relative_progress), progress)


def test_the_values_are_the_same(sides):
    models, trained = sides.models, sides.state.curriculum.models
    generated, theirs = rollouts_of(sides, GENERATED)
    progress = jax.random.uniform(jax.random.key(6), generated.length.shape)

    def loss(ensembles):
        losses = (
            sides.objectives.value_loss(ensemble, generated.w, outcome)[0]
            for ensemble, outcome in zip(ensembles, (progress, generated.episode_return), strict=True)
        )
        return sum(losses, jnp.float32(0.0))

    ours, gradients = jax.jit(jax.value_and_grad(loss))((trained.progress_value, trained.return_value))
    their_loss = models.value_loss(theirs.w, tensors(progress), theirs.episode_return)
    their_loss.backward()
    assert_close(their_loss, ours)
    for ensemble, gradient in zip(models.values, gradients, strict=True):
        assert_gradients_close(torch_weights.ensemble(ensemble, gradient))


def test_the_generator_is_the_same(sides):
    config, hparams, models, curriculum = sides.config, sides.hparams, sides.models, sides.state.curriculum
    z = jax.random.normal(jax.random.key(7), (config.model_batch_size, config.noise_size))
    # Away from the divergence's minimum, so that its gradient counts.
    params = jax.tree.map(lambda x: 1.1 * x + 0.01, curriculum.models.generator)
    torch_weights.load(models.generator, torch_weights.generator(models.generator, params))

    generator = sides.objectives.networks.generator
    variables = {"params": params, "batch_stats": curriculum.batch_stats}
    proposed = jax.jit(lambda variables: generator.apply(variables, z, train=False))(variables)
    models.generator.eval()
    with torch.no_grad():
        theirs = models.generator(tensors(z))
    models.generator.train()
    for name, block in proposed.items():
        assert_close(theirs[name], block)

    def loss(params):
        ensembles = curriculum.models.progress_value, curriculum.models.return_value
        return sides.objectives.generator_loss(params, curriculum.batch_stats, z, ensembles, jnp.float32(2.0), hparams)

    (ours, (batch_stats, _)), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(params)
    their_loss = models.generator_loss(tensors(z), torch.tensor(2.0))
    their_loss.backward()
    assert_close(their_loss, ours)
    assert_gradients_close(torch_weights.generator(models.generator, gradient))
    means = [(layer.running_mean, stats["mean"]) for layer, stats in torch_weights.norms(models.generator, batch_stats)]
    for theirs_mean, mean in means:
        assert_close(theirs_mean, mean)


def their_replay(sides, seed):
    """A replay of theirs that holds what ours holds."""
    rings = sides.state.replay
    theirs = _torch_replay.Replay(sides.config, np.random.default_rng(seed))
    for name in ("obs", "next_obs", "action", "reward", "terminated"):
        setattr(theirs, name, jax.tree.map(np.asarray, getattr(rings.transitions, name)))
    for name in ("w", "env", "end", "length", "episode_return", "success"):
        setattr(theirs, name, jax.tree.map(np.asarray, getattr(rings.episodes, name)))
    theirs.action = theirs.action.astype(np.int64)
    theirs.finished = rings.finished.tolist()
    return theirs


def assert_same_distribution(theirs, ours):
    """Means of every number over many draws, within five standard errors."""
    theirs, ours = (np.asarray(x, np.float64).reshape(len(x), -1) for x in (theirs, ours))
    error = np.sqrt(theirs.var(axis=0) / len(theirs) + ours.var(axis=0) / len(ours))
    assert (np.abs(theirs.mean(axis=0) - ours.mean(axis=0)) <= 5.0 * error + 1e-6).all()


def test_transitions_are_drawn_alike(sides):
    config, hparams = sides.config, sides.hparams
    arguments = {"batch_size": 8_000, "gamma": hparams.gamma, "success_share": config.success_share}
    ours = replay.sample_transitions(
        sides.state.replay, jax.random.key(8), sides.iteration, batches=1, n_step=1, horizon=HORIZON, **arguments
    )
    theirs = their_replay(sides, seed=0).sample_transitions(int(sides.iteration), **arguments)
    for half in (slice(4_000), slice(4_000, None)):  # the sources
        for name in ("action", "reward", "discount"):
            assert_same_distribution(getattr(theirs, name)[half], getattr(ours, name)[0, half])
        for name in SPACE.obs_spec:
            assert_same_distribution(theirs.obs[name][half], ours.obs[name][0, half])
            assert_same_distribution(theirs.next_obs[name][half], ours.next_obs[name][0, half])


@pytest.mark.parametrize(("source", "recency"), [(TARGET, 1.0), (GENERATED, 3.0)])
def test_rollouts_are_drawn_alike(sides, source, recency):
    config = sides.config
    arguments = {
        "source": source,
        "batch_size": 4_000,
        "steps": config.rollout_steps,
        "recent": config.recent_steps // config.envs_per_source,
        "recency": recency,
    }
    ours = replay.sample_rollouts(sides.state.replay, jax.random.key(9), sides.iteration, **arguments)
    theirs = their_replay(sides, seed=1).sample_rollouts(int(sides.iteration), **arguments)
    assert_same_distribution(theirs.length, ours.length)
    assert_same_distribution(theirs.episode_return, ours.episode_return)
    assert_same_distribution(theirs.w["xy"], ours.w["xy"])
    # All steps of an episode are drawn alike, so the first stands for them.
    for name in ("action", "reward"):
        assert_same_distribution(getattr(theirs, name)[:, 0], getattr(ours.steps, name)[:, 0])
    for name in SPACE.obs_spec:
        assert_same_distribution(theirs.initial_obs[name], ours.initial_obs[name])
        assert_same_distribution(theirs.obs[name][:, 0], ours.steps.obs[name][:, 0])
        assert_same_distribution(theirs.next_obs[name][:, 0], ours.steps.next_obs[name][:, 0])


def quick(preset):
    """A training small enough to run in seconds, and its problem."""
    problem = _measure.load_problem(preset, **_measure.QUICK)
    return problem, _torch_apt_gen.Training(problem.config, problem.hparams, problem.target, seed=0)


@pytest.mark.parametrize("preset", PRESETS)
def test_training_goes_on(preset):
    problem, training = quick(preset)
    training.warm_up()
    assert training.iteration * training.steps_per_iteration == problem.config.warmup_steps
    networks = [training.policy.online, training.policy.average, training.models.generator]
    networks += [training.models.discriminator, training.models.values]
    before = [parameter.detach().clone() for network in networks for parameter in network.parameters()]
    training.train(40)
    after = [parameter for network in networks for parameter in network.parameters()]
    for old, new in zip(before, after, strict=True):
        assert torch.isfinite(new).all()
        assert (old != new).any()


def test_schedules_are_the_same(sides):
    """Epsilon, and beta after the episodes of the replay."""
    training = quick("fast")[1]
    config, hparams = training.config, training.hparams = sides.config, sides.hparams
    for steps in (0, 400, 10_000):
        training.iteration = (config.warmup_steps + steps) // training.steps_per_iteration
        assert training.epsilon() == pytest.approx(float(learner.epsilon_schedule(jnp.int32(steps), hparams)), rel=1e-6)

    training.replay = their_replay(sides, seed=2)
    curriculum = apt_gen.make(SPACE, dataclasses.replace(config, warmup_steps=500))
    training.config = dataclasses.replace(config, warmup_steps=500)
    for delta in (-0.5, 0.5):
        training.hparams = dataclasses.replace(hparams, delta=delta)
        training.beta = hparams.beta_init
        training.refresh()
        state = curriculum.refresh(
            sides.state.curriculum, jax.random.key(10), sides.state.replay, sides.iteration, training.hparams
        )
        assert training.beta == float(state.beta)
    assert training.beta != hparams.beta_init
