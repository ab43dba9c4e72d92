"""ICM: paid for what the agent cannot predict (Pathak et al. 2017)."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Integer, Key

from apt_jax.bonuses.base import Bonus, Step, Steps, Stream, leading, pay, sample
from apt_jax.config import Config, HParams
from apt_jax.descent import ADAM, adam_step, has_learned
from apt_jax.networks import Dynamics
from apt_jax.networks.apply import apply
from apt_jax.plugin import Metrics
from apt_jax.replay import Batch, Replay
from apt_jax.specs import obs_struct, zeros_like
from apt_jax.task_space import TaskSpace


class IcmState(NamedTuple):
    """The dynamics model, its optimiser, and the returns it has led to."""

    params: Any
    opt_state: Any
    stream: Stream


def make(space: TaskSpace, config: Config) -> Bonus:
    """Half the squared error of the predicted embedding, times `HParams.icm_scale`.

    The embedding learns from the inverse loss alone, the forward model from the other: they share no parameter, so the paper's
    weights of the two (0.8 and 0.2) would change nothing under Adam.
    """
    network = Dynamics(space.obs_spec, space.num_actions)

    def init(key: Key[Array, ""], states: Any, hparams: HParams) -> IcmState:
        del hparams
        obs = zeros_like(obs_struct(space.obs_spec))
        params = network.init(key, obs, jnp.int32(0), obs, detach=True)
        return IcmState(params, ADAM.init(params), Stream.start(leading(states)))

    def bonus(state: IcmState, steps: Steps, hparams: HParams) -> Float[Array, "..."]:
        _, predicted, embedding = apply(network, state.params, steps.obs, steps.action, steps.next_obs, detach=True)
        return hparams.icm_scale * prediction_error(predicted, embedding)

    def annotate(state: IcmState, step: Step, hparams: HParams) -> tuple[IcmState, Any]:
        paid = step.transition.reward + bonus(state, step.transition, hparams)
        stream = state.stream.step(paid, step.transition.done, learning=has_learned(state.opt_state))
        return state._replace(stream=stream), ()

    def reward(state: IcmState, batch: Batch, hparams: HParams) -> tuple[Float[Array, "..."], Metrics]:
        return pay(batch, bonus(state, batch, hparams))

    def update(
        state: IcmState, key: Key[Array, ""], replay: Replay, iteration: Int[Array, ""], hparams: HParams
    ) -> tuple[IcmState, Metrics]:
        obs, action, next_obs = sample(space, config, replay, key, iteration)

        def loss(params: Any) -> tuple[Float[Array, ""], Metrics]:
            logits, predicted, embedding = apply(network, params, obs, action, next_obs, detach=True)
            inverse, forward = losses(logits, action, predicted=predicted, embedding=embedding)
            return inverse + forward, {"icm_inverse_loss": inverse, "icm_forward_loss": forward}

        grads, metrics = jax.grad(loss, has_aux=True)(state.params)
        params, opt_state = adam_step(state.params, state.opt_state, grads, hparams.bonus_learning_rate)
        return IcmState(params, opt_state, state.stream), metrics

    def return_range(state: IcmState, replay: Replay) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return state.stream.bounds(replay)

    return Bonus((), init, annotate, reward, update, return_range)


def prediction_error(predicted: Float[Array, "*batch d"], embedding: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    """Half the squared distance."""
    return 0.5 * jnp.sum((predicted - embedding) ** 2, axis=-1)


def losses(
    logits: Float[Array, "B A"], action: Integer[Array, "B"], *, predicted: Float[Array, "B d"], embedding: Float[Array, "B d"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Inverse loss (cross-entropy of the action) and forward loss."""
    inverse = optax.losses.softmax_cross_entropy_with_integer_labels(logits, action.astype(jnp.int32))
    return jnp.mean(inverse), jnp.mean(prediction_error(predicted, embedding))
