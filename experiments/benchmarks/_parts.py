"""The parts of one training iteration, each able to run by itself, rebuilt from the functions that the trainer is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from apt_jax import learner, replay, workers
from apt_jax.curricula import apt_gen
from apt_jax.curricula.apt_gen_objectives import make_objectives
from apt_jax.curricula.base import GENERATED, TARGET
from apt_jax.descent import ADAM, adam_step
from apt_jax.methods import make_method
from apt_jax.networks import QNetwork
from apt_jax.specs import zeros_like
from apt_jax.trainer import Clock, TrainState
from experiments.benchmarks._measure import Problem, Timing, time_loop

SOURCES = 2


class Part(NamedTuple):
    """A piece of a training iteration.

    Attributes:
      step: `step(state, fixed, key, iteration) -> (state, output)`: what one iteration does of it.
      state: what it changes.
      fixed: what it only reads.
    """

    step: Callable[[Any, Any, Key[Array, ""], Int[Array, ""]], tuple[Any, Any]]
    state: Any
    fixed: Any


def time_part(part: Part, clock: Clock, *, repeats: int, at_least: float) -> Timing:
    """Times one run of a part, iterations counted on from `clock`.

    The output is carried from run to run only so that it has to be computed and stored, as it is in training.
    """
    Carry = tuple[Any, Key[Array, ""], Int[Array, ""], Any]

    def step(carry: Carry, fixed: Any) -> Carry:
        state, key, iteration, _ = carry
        key, key_step = jax.random.split(key)
        state, output = part.step(state, fixed, key_step, iteration)
        return state, key, iteration + 1, output

    key = jax.random.key(0)
    _, output = jax.eval_shape(part.step, part.state, part.fixed, key, clock.iteration)
    carry = part.state, key, clock.iteration, zeros_like(output)
    return time_loop(step, carry, part.fixed, repeats=repeats, at_least=at_least)


def sample_batches(
    problem: Problem, rings: replay.Replay, key: Key[Array, ""], iteration: Int[Array, ""], batches: int
) -> replay.Batch:
    """Batches for so many policy updates, leaves [batches, B, ...], as the trainer draws them; consumes `key`."""
    space, _, config, hparams = problem
    return replay.sample_transitions(
        rings,
        key,
        iteration,
        batches=batches,
        batch_size=config.batch_size,
        n_step=config.n_step,
        success_share=config.success_share,
        horizon=space.horizon,
        gamma=hparams.gamma,
    )


def iteration_parts(problem: Problem, state: TrainState, clock: Clock) -> dict[str, Part]:
    """What every iteration does, in order, and what every `refresh_every` steps adds, from a state of training."""
    space, target, config, hparams = problem
    curriculum, _ = make_method(space, config)
    network = QNetwork(space.obs_spec, space.num_actions)
    envs = config.envs_per_source
    updates = config.updates_per_step * SOURCES * envs
    rounds = round(config.model_updates_per_step * SOURCES * envs)

    def propose(_: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del iteration
        return (), workers.assign(space, target, curriculum.propose(fixed, key, envs, hparams), envs)

    def act_and_step(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        params, assignment = fixed
        key_act, key_step = jax.random.split(key)
        action = learner.epsilon_greedy(network, params, state.obs, key_act, hparams.epsilon_end)
        state, transition, _, episode, done = workers.step(space, state, action, assignment, iteration, key_step)
        return state, (transition, episode, done)

    def write(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del key
        transition, episode, done = fixed
        return replay.write(state, iteration, transition, episode, done), ()

    def sample(_: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        return (), sample_batches(problem, fixed, key, iteration, updates)

    def update_policy(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del key, iteration
        batches, (low, high) = fixed
        return jax.lax.scan(
            lambda carry, batch: learner.update(network, carry, batch, low=low, high=high, hparams=hparams), state, batches
        )

    def update_models(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        return jax.lax.scan(
            lambda carry, key: curriculum.update(carry, key, fixed, iteration, hparams), state, jax.random.split(key, rounds)
        )

    def refresh(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        return curriculum.refresh(state, key, fixed, iteration, hparams), ()

    key_propose, key_step, key_sample = jax.random.split(jax.random.key(1), 3)
    params = state.learner.params
    _, assignment = jax.jit(propose)((), state.curriculum, key_propose, clock.iteration)
    _, recorded = jax.jit(act_and_step)(state.workers, (params, assignment), key_step, clock.iteration)
    # The latest iteration written is the one before the clock's.
    _, batches = jax.jit(sample)((), state.replay, key_sample, clock.iteration - 1)
    return {
        "propose tasks": Part(propose, (), state.curriculum),
        "act and step": Part(act_and_step, state.workers, (params, assignment)),
        "write": Part(write, state.replay, recorded),
        "sample": Part(sample, (), state.replay),
        "update policy": Part(update_policy, state.learner, (batches, state.replay.returns.bounds())),
        "update models": Part(update_models, state.curriculum, state.replay),
        "refresh": Part(refresh, state.curriculum, state.replay),
    }


def model_parts(problem: Problem, state: TrainState, clock: Clock) -> dict[str, Part]:
    """One model update of APT-Gen split up: each objective's forward and backward pass and Adam without the others."""
    space, _, config, hparams = problem
    objectives = make_objectives(space, config)
    # Fresh: how well the networks are trained changes nothing in their cost.
    fresh = jax.jit(apt_gen.make(space, config).init)(jax.random.key(3), hparams)
    models = fresh.models

    def sample(_: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        def rollouts(key: Key[Array, ""], source: int, recency: Float[Array, ""] | float) -> replay.Rollouts:
            return replay.sample_rollouts(
                fixed,
                key,
                iteration,
                source=source,
                batch_size=config.model_batch_size,
                steps=config.rollout_steps,
                recent=config.recent_steps // config.envs_per_source,
                recency=recency,
            )

        key_target, key_generated = jax.random.split(key)
        return (), (rollouts(key_target, TARGET, 1.0), rollouts(key_generated, GENERATED, hparams.recency))

    def optimise(loss: Callable[[Any], tuple[Float[Array, ""], Any]], params: Any, opt_state: Any) -> Any:
        grads, aux = jax.grad(loss, has_aux=True)(params)
        return *adam_step(params, opt_state, grads, hparams.learning_rate), aux

    def update_discriminator(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del key
        params, opt_state, spectral = state
        target, generated = _alternate(fixed, iteration)
        params, opt_state, (_, spectral) = optimise(
            lambda params: objectives.discriminator_loss(params, spectral, target, generated, hparams), params, opt_state
        )
        return (params, opt_state, spectral), ()

    def update_values(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del key
        _, generated = _alternate(fixed, iteration)

        def loss(ensembles: Any) -> tuple[Float[Array, ""], Any]:
            # What V1 learns costs the same as what V2 learns.
            losses = [objectives.value_loss(ensemble, generated.w, generated.episode_return)[0] for ensemble in ensembles]
            return sum(losses, jnp.float32(0.0)), ()

        params, opt_state, _ = optimise(loss, *state)
        return (params, opt_state), ()

    def update_generator(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del iteration
        params, opt_state, batch_stats = state
        z = jax.random.normal(key, (config.model_batch_size, config.noise_size))
        params, opt_state, (batch_stats, _) = optimise(
            lambda params: objectives.generator_loss(params, batch_stats, z, fixed, jnp.float32(1.0), hparams),
            params,
            opt_state,
        )
        return (params, opt_state, batch_stats), ()

    record = jax.jit(jax.vmap(sample, in_axes=(None, None, 0, None)))
    _, rollouts = record((), state.replay, jax.random.split(jax.random.key(2)), clock.iteration - 1)
    ensembles = models.progress_value, models.return_value
    discriminator_state = models.discriminator, ADAM.init(models.discriminator), fresh.spectral
    generator_state = models.generator, ADAM.init(models.generator), fresh.batch_stats
    return {
        "sample rollouts": Part(sample, (), state.replay),
        "discriminator": Part(update_discriminator, discriminator_state, rollouts),
        "values": Part(update_values, (ensembles, ADAM.init(ensembles)), rollouts),
        "generator": Part(update_generator, generator_state, ensembles),
    }


def policy_update(problem: Problem, state: TrainState, batch: replay.Batch) -> Any:
    """One policy update as a call without loops, to count its operations by."""
    network = QNetwork(problem.space.obs_spec, problem.space.num_actions)
    low, high = state.replay.returns.bounds()
    return learner.update(network, state.learner, batch, low=low, high=high, hparams=problem.hparams)


def _alternate(recorded: Any, iteration: Int[Array, ""]) -> Any:
    """One of the recorded batches, in turn: work on a batch that never changes would be moved out of the loop."""
    return jax.tree.map(lambda x: x[iteration % jax.tree.leaves(recorded)[0].shape[0]], recorded)
