"""The parts of one training iteration, each able to run by itself, rebuilt from the functions that the trainer is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key

from apt_jax import learner, replay, workers
from apt_jax.curricula import make_curriculum
from apt_jax.curricula.apt_gen import as_instantiated, pessimistic
from apt_jax.curricula.base import GENERATED, TARGET
from apt_jax.losses import discriminator_loss, generator_objective
from apt_jax.networks import Discriminator, Generator, QNetwork, ValueNetwork, init_singular_vectors, pool, spectral_normalize
from apt_jax.networks.apply import apply
from apt_jax.specs import obs_struct, param_struct, zeros_like
from apt_jax.trainer import Clock, TrainState
from experiments.benchmarks._measure import Problem, Timing, time_loop

SOURCES = 2
_ADAM = optax.flatten(optax.scale_by_adam())


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


def iteration_parts(problem: Problem, state: TrainState, clock: Clock) -> dict[str, Part]:
    """What every iteration does, in order, and what every `refresh_every` steps adds, from a state of training."""
    space, target, config, hparams = problem
    curriculum = make_curriculum(space, config)
    network = QNetwork(space.obs_spec, space.num_actions)
    envs = config.envs_per_source
    updates = config.updates_per_step * SOURCES * envs
    rounds = round(config.model_updates_per_step * SOURCES * envs)

    def act(_: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del iteration
        params, obs = fixed
        return (), learner.epsilon_greedy(network, params, obs, key, hparams.epsilon_end)

    def propose(_: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del iteration
        return (), workers.assign(space, target, curriculum.propose(fixed, key, envs, hparams), envs)

    def step(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        state, *recorded = workers.step(space, state, fixed[0], fixed[1], iteration, key)
        return state, recorded

    def write(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del key
        transition, episode, done = fixed
        return replay.write(state, iteration, transition, episode, done), ()

    def sample(_: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        batches = replay.sample_transitions(
            fixed,
            key,
            iteration,
            batches=updates,
            batch_size=config.batch_size,
            n_step=config.n_step,
            gamma=hparams.gamma,
        )
        return (), batches

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
        del key, iteration
        return curriculum.refresh(state, fixed, hparams), ()

    key_act, key_propose, key_step, key_sample = jax.random.split(jax.random.key(1), 4)
    params, obs = state.learner.params, state.workers.obs
    _, action = jax.jit(act)((), (params, obs), key_act, clock.iteration)
    _, assignment = jax.jit(propose)((), state.curriculum, key_propose, clock.iteration)
    _, recorded = jax.jit(step)(state.workers, (action, assignment), key_step, clock.iteration)
    # The latest iteration written is the one before the clock's.
    _, batches = jax.jit(sample)((), state.replay, key_sample, clock.iteration - 1)
    return {
        "act": Part(act, (), (params, obs)),
        "propose tasks": Part(propose, (), state.curriculum),
        "step environments": Part(step, state.workers, (action, assignment)),
        "write": Part(write, state.replay, recorded),
        "sample": Part(sample, (), state.replay),
        "update policy": Part(update_policy, state.learner, (batches, replay.return_range(state.replay))),
        "update models": Part(update_models, state.curriculum, state.replay),
        "refresh": Part(refresh, state.curriculum, state.replay),
    }


def model_parts(problem: Problem, state: TrainState, clock: Clock) -> dict[str, Part]:
    """One model update of APT-Gen split up: each network's forward and backward pass and Adam without the others."""
    space, _, config, hparams = problem
    generator, discriminator = Generator(space.param_spec), Discriminator(space.obs_spec, space.num_actions)
    value = ValueNetwork(space.param_spec)

    def sample(_: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        def rollouts(key: Key[Array, ""], source: int) -> replay.Rollouts:
            return replay.sample_rollouts(
                fixed,
                key,
                iteration,
                source=source,
                batch_size=config.model_batch_size,
                steps=config.rollout_steps,
                recent=config.recent_steps // config.envs_per_source,
            )

        key_target, key_generated = jax.random.split(key)
        target, generated = rollouts(key_target, TARGET), rollouts(key_generated, GENERATED)
        return (), (jax.tree.map(lambda a, b: jnp.concatenate([a, b]), target, generated), generated)

    def descend(loss: Callable[[Any], tuple[Float[Array, ""], Any]], params: Any, opt_state: Any) -> Any:
        grads, aux = jax.grad(loss, has_aux=True)(params)
        direction, opt_state = _ADAM.update(grads, opt_state)
        return jax.tree.map(lambda p, d: p - hparams.learning_rate * d, params, direction), opt_state, aux

    def update_discriminator(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del key
        params, opt_state, spectral = state
        both, _ = _alternate(fixed, iteration)

        def loss(params: Any) -> tuple[Float[Array, ""], Any]:
            normal, moved = spectral_normalize(params, spectral, bound=hparams.spectral_bound)
            steps = both.steps
            initial = apply(discriminator, normal, both.initial_obs, method="score_init")
            transitions = apply(
                discriminator,
                normal,
                steps.obs,
                steps.action,
                reward=steps.reward,
                next_obs=steps.next_obs,
                method="score_step",
            )
            return discriminator_loss(*jnp.split(pool(initial, transitions, both.length), 2)), moved

        return descend(loss, params, opt_state), ()

    def evaluate(ensemble: Any, w: Any) -> Float[Array, "K B"]:
        return jax.vmap(lambda params: apply(value, params, as_instantiated(space.param_spec, w)))(ensemble)

    def update_values(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del key
        _, generated = _alternate(fixed, iteration)

        def loss(params: Any) -> tuple[Float[Array, ""], Any]:
            outcome = generated.episode_return[None]  # what V1 learns costs the same as what V2 learns
            errors = jnp.concatenate([evaluate(ensemble, generated.w) - outcome for ensemble in params])
            return jnp.sum(jnp.mean(errors**2, axis=1)), ()

        params, opt_state, _ = descend(loss, *state)
        return (params, opt_state), ()

    def update_generator(state: Any, fixed: Any, key: Key[Array, ""], iteration: Int[Array, ""]) -> Any:
        del iteration
        params, opt_state, batch_stats = state

        def loss(params: Any) -> tuple[Float[Array, ""], Any]:
            z = jax.random.normal(key, (config.model_batch_size, config.noise_size))
            variables = {"params": params, "batch_stats": batch_stats}
            w, updated = apply(generator, variables, z, train=True, mutable=["batch_stats"])
            progress, value = (pessimistic(evaluate(ensemble, w), hparams.pessimism) for ensemble in fixed)
            return -generator_objective(progress, value, beta=hparams.beta_init, delta=hparams.delta), updated["batch_stats"]

        return descend(loss, params, opt_state), ()

    @jax.jit
    def init(key: Key[Array, ""]) -> Any:
        """States of the three updates; how well the networks are trained changes nothing in their cost."""
        key_d, key_spectral, key_value, key_g = jax.random.split(key, 4)
        obs, w = zeros_like(obs_struct(space.obs_spec)), zeros_like(param_struct(space.param_spec))
        params_d: Any = discriminator.init(key_d, obs, jnp.int32(0), reward=jnp.float32(0.0), next_obs=obs)
        keys = jax.random.split(key_value, (2, config.value_ensemble))
        progress_value, return_value = (jax.vmap(lambda key: value.init(key, w))(ensemble) for ensemble in keys)
        values = progress_value, return_value
        variables = generator.init(key_g, jnp.zeros((2, config.noise_size)), train=True)
        return (
            (params_d, _ADAM.init(params_d), init_singular_vectors(key_spectral, params_d)),
            (values, _ADAM.init(values)),
            (variables["params"], _ADAM.init(variables["params"]), variables["batch_stats"]),
        )

    key_init, key_sample = jax.random.split(jax.random.key(2))
    discriminator_state, value_state, generator_state = init(key_init)
    record = jax.jit(jax.vmap(sample, in_axes=(None, None, 0, None)))
    _, rollouts = record((), state.replay, jax.random.split(key_sample), clock.iteration - 1)
    return {
        "sample rollouts": Part(sample, (), state.replay),
        "discriminator": Part(update_discriminator, discriminator_state, rollouts),
        "values": Part(update_values, value_state, rollouts),
        "generator": Part(update_generator, generator_state, value_state[0]),
    }


def policy_update(problem: Problem, state: TrainState, batch: replay.Batch) -> Any:
    """One policy update as a call without loops, to count its operations by."""
    network = QNetwork(problem.space.obs_spec, problem.space.num_actions)
    low, high = replay.return_range(state.replay)
    return learner.update(network, state.learner, batch, low=low, high=high, hparams=problem.hparams)


def _alternate(recorded: Any, iteration: Int[Array, ""]) -> Any:
    """One of the recorded batches, in turn: work on a batch that never changes would be moved out of the loop."""
    return jax.tree.map(lambda x: x[iteration % jax.tree.leaves(recorded)[0].shape[0]], recorded)
