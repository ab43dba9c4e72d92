"""GoalGAN: tasks that succeed sometimes, from a GAN trained on tasks so labelled (Held et al. 2018).

Success is the environment's own flag.  Until the networks have been trained on a good task, tasks are uniform.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from apt_jax import draws
from apt_jax import replay as rp
from apt_jax.config import Config, HParams
from apt_jax.curricula.base import GENERATED, Curriculum
from apt_jax.descent import descend
from apt_jax.losses import lsgan_discriminator_loss, lsgan_generator_loss
from apt_jax.networks.apply import apply
from apt_jax.plugin import Metrics
from apt_jax.specs import Params, block_weights, flatten, unflatten
from apt_jax.task_space import TaskSpace

_RMSPROP = optax.flatten(optax.scale_by_rms())


class TaskGenerator(nn.Module):
    """Noise to a flattened task in [-1, 1]: two layers of 256, tanh (as in public implementations)."""

    size: int

    @nn.compact
    def __call__(self, z: Float[Array, "*batch z"]) -> Float[Array, "*batch D"]:
        for _ in range(2):
            z = nn.relu(nn.Dense(256)(z))
        return nn.tanh(nn.Dense(self.size)(z))


class TaskCritic(nn.Module):
    """A flattened task to its score: two layers of 128 (as in public implementations)."""

    @nn.compact
    def __call__(self, task: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
        for _ in range(2):
            task = nn.leaky_relu(nn.Dense(128)(task))
        return nn.Dense(1)(task).squeeze(-1)


class Labelled(NamedTuple):
    """Latest tasks, flattened to [-1, 1]; `good` is 1 if the rate of success is within bounds, `judged` whether it counts."""

    tasks: Float[Array, "n D"]
    good: Float[Array, "n"]
    judged: Bool[Array, "n"]


class Memory(NamedTuple):
    """A ring of tasks that were good once, and how many there have been."""

    tasks: Float[Array, "M D"]
    written: Int[Array, ""]


class GoalGanState(NamedTuple):
    """Generator, critic and optimiser, and what they learn from.

    Attributes:
      seen: generated episodes that have been looked at.
      trained: whether the networks have learned from a good task.
    """

    networks: tuple[Any, Any]
    opt_state: Any
    labelled: Labelled
    memory: Memory
    seen: Int[Array, ""]
    trained: Bool[Array, ""]


def make(space: TaskSpace, config: Config) -> Curriculum:
    """A least-squares GAN over the flattened task parameter.

    It learns as often as the other models, `Config.model_updates_per_step`, which is more often than in the reference (250
    rounds of batches of 64 per 100 new tasks).  Its first good tasks are those of the uniformly random policy of the warm-up.

    Raises:
      ValueError: the replay does not hold the episodes of the tasks that it learns from.
    """
    episodes = config.goal_tasks * config.goal_rollouts
    if config.replay_episodes < episodes:
        raise ValueError(f"goal_tasks * goal_rollouts must be at most replay_episodes={config.replay_episodes}, got {episodes}")
    if config.goal_memory < config.goal_tasks:
        raise ValueError(f"goal_memory must hold the good ones of goal_tasks={config.goal_tasks}, got {config.goal_memory}")
    size = block_weights(space.param_spec).size
    generator, critic = TaskGenerator(size), TaskCritic()

    def init(key: Key[Array, ""], hparams: HParams) -> GoalGanState:
        del hparams
        key_generator, key_critic = jax.random.split(key)
        networks = generator.init(key_generator, jnp.zeros(config.noise_size)), critic.init(key_critic, jnp.zeros(size))
        return GoalGanState(
            networks,
            _RMSPROP.init(networks),
            Labelled(jnp.zeros((episodes, size)), jnp.zeros(episodes), jnp.zeros(episodes, bool)),
            Memory(jnp.zeros((config.goal_memory, size)), jnp.int32(0)),
            seen=jnp.int32(0),
            trained=jnp.bool(False),
        )

    def propose(state: GoalGanState, key: Key[Array, ""], n: int, hparams: HParams) -> Params:
        key_z, key_old, key_choice, key_noise, key_uniform = jax.random.split(key, 5)
        new = apply(generator, state.networks[0], jax.random.normal(key_z, (n, config.noise_size)))
        kept = jnp.minimum(state.memory.written, config.goal_memory)
        old = state.memory.tasks[draws.integers(key_old, (n,), jnp.maximum(kept, 1))]
        again = (jax.random.uniform(key_choice, (n,)) < hparams.goal_old_share) & (kept > 0)
        task = jnp.where(again[:, None], old, new) + hparams.goal_noise * jax.random.normal(key_noise, (n, size))
        drawn = unflatten(space.param_spec, 0.5 * (task + 1.0))
        uniform = jax.vmap(space.sample_uniform)(jax.random.split(key_uniform, n))
        return jax.tree.map(lambda d, u: jnp.where(state.trained, d, u), drawn, uniform)

    def update(
        state: GoalGanState, key: Key[Array, ""], replay: rp.Replay, iteration: Int[Array, ""], hparams: HParams
    ) -> tuple[GoalGanState, Metrics]:
        del replay, iteration
        key_rows, key_z = jax.random.split(key)
        tasks, good, judged = state.labelled
        rows = jax.random.categorical(key_rows, jnp.where(judged, 0.0, -jnp.inf), shape=(config.model_batch_size,))
        z = jax.random.normal(key_z, (config.model_batch_size, config.noise_size))

        def loss(networks: tuple[Any, Any]) -> tuple[Float[Array, ""], Metrics]:
            """Each network receives the gradient of its own loss alone."""
            params_g, params_d = networks
            generated = apply(generator, params_g, z)
            loss_d = lsgan_discriminator_loss(
                good[rows],
                apply(critic, params_d, tasks[rows]),
                apply(critic, params_d, jax.lax.stop_gradient(generated)),
            )
            loss_g = lsgan_generator_loss(apply(critic, jax.lax.stop_gradient(params_d), generated))
            return loss_d + loss_g, {"goal_critic_loss": loss_d, "goal_generator_loss": loss_g}

        grads, metrics = jax.grad(loss, has_aux=True)(state.networks)
        direction, opt_state = _RMSPROP.update(grads, state.opt_state)
        networks = descend(state.networks, direction, hparams.goal_learning_rate)
        # Without a single good task there is nothing to learn but that all is bad.
        learns = any_good(state.labelled)
        networks, opt_state = jax.tree.map(
            lambda new, old: jnp.where(learns, new, old), (networks, opt_state), (state.networks, state.opt_state)
        )
        return state._replace(networks=networks, opt_state=opt_state), metrics

    def refresh(
        state: GoalGanState, key: Key[Array, ""], replay: rp.Replay, iterations: Int[Array, ""], hparams: HParams
    ) -> GoalGanState:
        del key, iterations
        recent, earlier = rp.latest_episodes(replay, source=GENERATED, count=episodes)
        tasks = 2.0 * flatten(space.param_spec, recent.w) - 1.0
        rate, judged = success_rates(tasks, recent.success, earlier >= 0, rollouts=config.goal_rollouts)
        good = (hparams.goal_low <= rate) & (rate <= hparams.goal_high)
        return GoalGanState(
            state.networks,
            state.opt_state,
            Labelled(tasks, good.astype(jnp.float32), judged),
            remember(state.memory, tasks, good & judged & (earlier >= state.seen)),
            seen=earlier[0] + 1,
            trained=state.trained | any_good(state.labelled),
        )

    def report(state: GoalGanState, rollouts: rp.Rollouts, hparams: HParams) -> Metrics:
        del rollouts, hparams
        judged = state.labelled.judged.astype(jnp.float32)
        return {
            "goal_good_share": jnp.sum(state.labelled.good * judged) / jnp.maximum(jnp.sum(judged), 1.0),
            "goal_remembered": jnp.minimum(state.memory.written, config.goal_memory).astype(jnp.float32),
        }

    return Curriculum(True, init, propose, update, refresh, report, rollouts=config.goal_rollouts)


def any_good(labelled: Labelled) -> Bool[Array, ""]:
    """Whether there is a task worth proposing."""
    return jnp.any(labelled.judged & (labelled.good > 0.0))


def success_rates(
    tasks: Float[Array, "n D"], success: Bool[Array, "n"], valid: Bool[Array, "n"], *, rollouts: int
) -> tuple[Float[Array, "n"], Bool[Array, "n"]]:
    """Rate of success of every episode's task, newest first, and whether the episode is the last of the task's `rollouts`."""
    same = jnp.all(tasks[:, None, :] == tasks[None, :, :], axis=-1) & valid[:, None] & valid[None, :]
    count = jnp.sum(same, axis=1)
    wins = jnp.sum(same & success[None, :], axis=1)
    newer = jnp.tril(jnp.ones(same.shape, bool), k=-1)
    judged = (count >= rollouts) & ~jnp.any(same & newer, axis=1)
    return wins / jnp.maximum(count, 1), judged


def remember(memory: Memory, tasks: Float[Array, "n D"], good: Bool[Array, "n"]) -> Memory:
    """With the tasks that `good` marks in place of the oldest."""
    capacity = memory.tasks.shape[0]
    order = jnp.cumsum(good, dtype=jnp.int32) - 1
    slot = jnp.where(good, (memory.written + order) % capacity, capacity)
    return Memory(memory.tasks.at[slot].set(tasks, mode="drop"), memory.written + jnp.sum(good, dtype=jnp.int32))
