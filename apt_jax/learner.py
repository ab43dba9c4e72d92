"""Double DQN: parameters, epsilon-greedy acting, updates, and the restore rule."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from apt_jax import draws
from apt_jax.config import HParams
from apt_jax.descent import ADAM, adam_step
from apt_jax.losses import td_errors, td_target
from apt_jax.networks import QNetwork
from apt_jax.networks.apply import apply
from apt_jax.replay import Batch
from apt_jax.specs import Obs, obs_struct, zeros_like


class LearnerState(NamedTuple):
    """What is learned of the Q-function.

    Attributes:
      params: the online network's, which collects.
      target_params: their Polyak average, for targets, and for judging the policy.  Values of actions differ by about
        1 - gamma, less than an update moves them: the greedy policy of the online network falls into loops and out of them
        from update to update, that of the average does not (experiments/NOTES.md, section 8).
      opt_state: Adam's.
    """

    params: Any
    target_params: Any
    opt_state: Any


class Kept(NamedTuple):
    """The learner as it was when the target return last did not drop, and that return (NaN before the first evaluation)."""

    learner: LearnerState
    score: Float[Array, ""]


def init(network: QNetwork, key: Key[Array, ""]) -> LearnerState:
    """Fresh parameters, the target network equal to them; consumes `key`."""
    params = network.init(key, zeros_like(obs_struct(network.obs_spec)))
    return LearnerState(params, jax.tree.map(jnp.copy, params), ADAM.init(params))


def greedy(network: QNetwork, params: Any, obs: Obs) -> Int[Array, "..."]:
    """The action of largest value for observations with any leading axes."""
    return jnp.argmax(apply(network, params, obs), axis=-1)


def epsilon_greedy(
    network: QNetwork, params: Any, obs: Obs, key: Key[Array, ""], epsilon: Float[Array, "..."] | float
) -> Int[Array, "..."]:
    """Greedy actions, each replaced by a uniform one with probability `epsilon`, one for all or one each; consumes `key`."""
    action = greedy(network, params, obs)
    chance, choice = draws.uniform(key, (2, *action.shape))
    return jnp.where(chance < epsilon, jnp.floor(choice * network.num_actions).astype(action.dtype), action)


def epsilon_schedule(steps: Int[Array, ""], hparams: HParams) -> Float[Array, ""]:
    """Linear from `epsilon_start` to `epsilon_end` over the first `epsilon_steps` environment steps after warm-up."""
    fraction = jnp.clip(steps.astype(jnp.float32) / hparams.epsilon_steps, 0.0, 1.0)
    return hparams.epsilon_start + fraction * (hparams.epsilon_end - hparams.epsilon_start)


def update(
    network: QNetwork,
    state: LearnerState,
    batch: Batch,
    *,
    low: Float[Array, ""],
    high: Float[Array, ""],
    hparams: HParams,
) -> tuple[LearnerState, dict[str, Float[Array, ""]]]:
    """One Double DQN update with Huber loss, Adam and a Polyak step of the target network.

    Args:
      batch: leaves [B, ...].
      low: lower bound of the next-Q clip.
      high: upper bound of the next-Q clip.

    Returns:
      The learner after it, and the batch's mean of the loss and of the online network's largest value before it.
    """
    next_value = apply(network, state.target_params, batch.next_obs)
    next_selector = apply(network, state.params, batch.next_obs)
    target = td_target(
        reward=batch.reward,
        discount=batch.discount,
        next_q_selector=next_selector,
        next_q_value=next_value,
        low=low,
        high=high,
    )

    def loss(params: Any) -> tuple[Float[Array, ""], Float[Array, "B A"]]:
        q = apply(network, params, batch.obs)
        return jnp.mean(optax.losses.huber_loss(td_errors(q, batch.action, target))), q

    (value, q), grads = jax.value_and_grad(loss, has_aux=True)(state.params)
    params, opt_state = adam_step(state.params, state.opt_state, grads, hparams.learning_rate)
    target_params = optax.incremental_update(params, state.target_params, hparams.target_rate)
    return LearnerState(params, target_params, opt_state), {"td_loss": value, "q_mean": jnp.mean(jnp.max(q, axis=-1))}


def keep_or_restore(state: LearnerState, kept: Kept, score: Float[Array, ""]) -> tuple[LearnerState, Kept, Bool[Array, ""]]:
    """The restore rule (paper, appendix "Stability"): go back if the target return was above 0 and has dropped.

    Equality is no drop, a NaN score is.  After a restore the accepted score stays.

    Returns:
      The learner to go on with, what is kept, and whether it was restored.
    """
    drop = (kept.score > 0.0) & ~(score >= kept.score)
    learner = jax.tree.map(lambda old, new: jnp.where(drop, old, new), kept.learner, state)
    return learner, Kept(learner, jnp.where(drop, kept.score, score)), drop


def reset(
    network: QNetwork,
    state: LearnerState,
    kept: Kept,
    key: Key[Array, ""],
    *,
    steps: Int[Array, ""],
    every: int,
    hparams: HParams,
) -> tuple[LearnerState, Bool[Array, ""]]:
    """A fresh Q-function every `reset_every` steps while what is kept earns nothing on the target; consumes `key`.

    Where nothing is reached, whatever was visited often is worth little, and so is, by then, what lies beyond it.  A fresh
    network explores once more, with a replay that knows the way (Nikishin et al. 2022, "The Primacy Bias in Deep
    Reinforcement Learning").

    Args:
      steps: environment steps after warm-up.
      every: steps between two calls.

    Returns:
      The learner to go on with, and whether it is fresh.
    """
    # Half a step more than a whole number of periods, and half less than the next: no rounding of the quotient moves a reset.
    now, before = (jnp.floor((count.astype(jnp.float32) + 0.5) / hparams.reset_every) for count in (steps, steps - every))
    due = (now > before) & ~(kept.score > 0.0)
    return jax.tree.map(lambda new, old: jnp.where(due, new, old), init(network, key), state), due
