"""RIDE: paid for changing the world, less for each visit of a state within an episode (Raileanu and Rocktaeschel 2020)."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from apt_jax.bonuses.base import Bonus, Step, Steps
from apt_jax.bonuses.embedding import dynamics_loss, init_dynamics
from apt_jax.bonuses.learned import learned
from apt_jax.config import Config, HParams
from apt_jax.networks import Dynamics
from apt_jax.networks.apply import apply
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


def make(space: TaskSpace, config: Config) -> Bonus:
    """Distance that an action moves the embedding, over the root of the visits of where it led, times `HParams.ride_scale`.

    Visits are counted when the step is made and stored with it; the embedding is today's.
    """
    network = Dynamics(space.obs_spec, space.num_actions)
    loss = dynamics_loss(network, "ride", inverse_weight=INVERSE_WEIGHT, forward_weight=FORWARD_WEIGHT, detach=False)
    fingerprint = over_environments(space.fingerprint)

    def init(key: Key[Array, ""], states: Any) -> tuple[Any, Visits]:
        visits = over_environments(partial(start_episode, horizon=space.horizon))(fingerprint(states))
        return init_dynamics(network, key), visits

    def observe(params: Any, memory: Visits, step: Step, learning: Bool[Array, ""]) -> tuple[Visits, Float[Array, "S E"]]:
        del params, learning
        done, begun = step.transition.done, fingerprint(step.begun)
        visits, note = over_environments(visit)(memory, fingerprint(step.state), done=done, begun=begun)
        return visits, note

    def price(params: Any, memory: Visits, steps: Steps, hparams: HParams) -> Float[Array, "..."]:
        del memory
        phi, next_phi = (apply(network, params, obs, method="embed") for obs in (steps.obs, steps.next_obs))
        return hparams.ride_scale * impact(phi, next_phi) * steps.note

    note = jax.ShapeDtypeStruct((), jnp.float32)
    return learned(space, config, note=note, init=init, observe=observe, price=price, loss=loss)


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
