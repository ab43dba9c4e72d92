"""RIDE: paid for changing the world, less for each visit of a state within an episode (Raileanu and Rocktaeschel 2020)."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from apt_jax.bonuses.base import Bonus, Step, Steps, Stream, leading, pay, sample
from apt_jax.bonuses.icm import losses
from apt_jax.config import Config, HParams
from apt_jax.descent import ADAM, adam_step, has_learned
from apt_jax.networks import Dynamics
from apt_jax.networks.apply import apply
from apt_jax.plugin import Metrics
from apt_jax.replay import Batch, Replay
from apt_jax.specs import obs_struct, zeros_like
from apt_jax.task_space import TaskSpace, over_environments

FORWARD_WEIGHT = 10.0
INVERSE_WEIGHT = 0.1
"""Of the two losses that the embedding learns from: the cross-entropy and half the squared error, as ICM has them.

The reference has the error's norm, so that its weights mean something else.
"""


class Visits(NamedTuple):
    """States visited in the current episode, its first one included.

    Attributes:
      fingerprints: one row per visit, of which the first `visited` are of this episode.
      visited: at most the horizon.
    """

    fingerprints: Int[Array, "H k"]
    visited: Int[Array, ""]


class RideState(NamedTuple):
    """The dynamics model, its optimiser, the visits of every environment, and the returns it has led to."""

    params: Any
    opt_state: Any
    visits: Visits
    stream: Stream


def make(space: TaskSpace, config: Config) -> Bonus:
    """Distance that an action moves the embedding, over the root of the visits of where it led, times `HParams.ride_scale`.

    Visits are counted when the step is made and stored with it; the embedding is today's.
    """
    network = Dynamics(space.obs_spec, space.num_actions)
    fingerprint = over_environments(space.fingerprint)

    def init(key: Key[Array, ""], states: Any, hparams: HParams) -> RideState:
        del hparams
        obs = zeros_like(obs_struct(space.obs_spec))
        params = network.init(key, obs, jnp.int32(0), obs, detach=False)
        visits = over_environments(partial(start_episode, horizon=space.horizon))(fingerprint(states))
        return RideState(params, ADAM.init(params), visits, Stream.start(leading(states)))

    def bonus(state: RideState, steps: Steps, hparams: HParams) -> Float[Array, "..."]:
        phi, next_phi = (apply(network, state.params, obs, method="embed") for obs in (steps.obs, steps.next_obs))
        return hparams.ride_scale * impact(phi, next_phi) * steps.note

    def annotate(state: RideState, step: Step, hparams: HParams) -> tuple[RideState, Float[Array, "S E"]]:
        done, begun = step.transition.done, fingerprint(step.begun)
        visits, note = over_environments(visit)(state.visits, fingerprint(step.state), done=done, begun=begun)
        paid = step.transition.reward + bonus(state, step.transition._replace(note=note), hparams)
        stream = state.stream.step(paid, done, learning=has_learned(state.opt_state))
        return state._replace(visits=visits, stream=stream), note

    def reward(state: RideState, batch: Batch, hparams: HParams) -> tuple[Float[Array, "..."], Metrics]:
        return pay(batch, bonus(state, batch, hparams))

    def update(
        state: RideState, key: Key[Array, ""], replay: Replay, iteration: Int[Array, ""], hparams: HParams
    ) -> tuple[RideState, Metrics]:
        obs, action, next_obs = sample(space, config, replay, key, iteration)

        def loss(params: Any) -> tuple[Float[Array, ""], Metrics]:
            logits, predicted, embedding = apply(network, params, obs, action, next_obs, detach=False)
            inverse, forward = losses(logits, action, predicted=predicted, embedding=embedding)
            return INVERSE_WEIGHT * inverse + FORWARD_WEIGHT * forward, {
                "ride_inverse_loss": inverse,
                "ride_forward_loss": forward,
            }

        grads, metrics = jax.grad(loss, has_aux=True)(state.params)
        params, opt_state = adam_step(state.params, state.opt_state, grads, hparams.bonus_learning_rate)
        return state._replace(params=params, opt_state=opt_state), metrics

    def return_range(state: RideState, replay: Replay) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return state.stream.bounds(replay)

    return Bonus(jax.ShapeDtypeStruct((), jnp.float32), init, annotate, reward, update, return_range)


def impact(phi: Float[Array, "*batch d"], next_phi: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    """Distance between two embeddings."""
    return jnp.sqrt(jnp.sum((next_phi - phi) ** 2, axis=-1))


def start_episode(first: Int[Array, "k"], horizon: int) -> Visits:
    """An episode in which only the first state has been visited."""
    return Visits(jnp.zeros((horizon, first.size), first.dtype).at[0].set(first), jnp.int32(1))


def visit(
    visits: Visits, state: Int[Array, "k"], *, done: Bool[Array, ""], begun: Int[Array, "k"]
) -> tuple[Visits, Float[Array, ""]]:
    """Count a visit, and start anew with the state `begun` if it was the episode's last.

    Returns:
      The visits, and 1 / sqrt(N) for the N visits of the state in its episode, this one included.
    """
    known = jnp.all(visits.fingerprints == state[None, :], axis=1)
    known &= jnp.arange(known.size, dtype=jnp.int32) < visits.visited
    at = jnp.where(done, 0, visits.visited)
    fingerprints = visits.fingerprints.at[at].set(jnp.where(done, begun, state))
    return Visits(fingerprints, at + 1), jax.lax.rsqrt(1.0 + jnp.sum(known, dtype=jnp.float32))
