"""The interface of a bonus: a reward of the agent's own making, added to what the environment pays.

Replay keeps what the environment paid.  The bonus of a step is recomputed from today's networks whenever the step is sampled;
only what cannot be recomputed later is noted down when it is made.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Integer, Key

from apt_jax.config import Config, HParams
from apt_jax.plugin import Metrics, UpdateFn
from apt_jax.replay import Batch, Replay, Transition, sample_transitions
from apt_jax.specs import Obs
from apt_jax.task_space import TaskSpace


class Step(NamedTuple):
    """One step of every environment; leaves [S, E, ...].

    `state` is the true state after it, `begun` the one that the next step starts from: that of a fresh episode where the
    transition is done, else the same.
    """

    transition: Transition
    state: Any
    begun: Any


@runtime_checkable
class Steps(Protocol):
    """Steps to be paid for, with any leading axes: a `Batch` or a `Transition`."""

    @property
    def obs(self) -> Obs: ...
    @property
    def action(self) -> Integer[Array, "..."]: ...
    @property
    def next_obs(self) -> Obs: ...
    @property
    def note(self) -> Any: ...


@runtime_checkable
class InitFn(Protocol):
    """`init(key, states, hparams) -> state`, for the environments' first states (leaves [S, E, ...]); consumes `key`."""

    def __call__(self, key: Key[Array, ""], states: Any, hparams: HParams) -> Any: ...


@runtime_checkable
class AnnotateFn(Protocol):
    """`annotate(state, step, hparams) -> (state, note)`: when steps are made; notes have leaves [S, E, ...]."""

    def __call__(self, state: Any, step: Step, hparams: HParams) -> tuple[Any, Any]: ...


@runtime_checkable
class RewardFn(Protocol):
    """`reward(state, batch, hparams) -> (reward, metrics)`: what to train on, the bonus added, for any leading axes."""

    def __call__(self, state: Any, batch: Batch, hparams: HParams) -> tuple[Float[Array, "..."], Metrics]: ...


@runtime_checkable
class ReturnRangeFn(Protocol):
    """`return_range(state, replay) -> (low, high)`: what next values are clipped to in the reward that is trained on."""

    def __call__(self, state: Any, replay: Replay) -> tuple[Float[Array, ""], Float[Array, ""]]: ...


class Bonus(NamedTuple):
    """A plug-in made of pure functions over an explicit state; unbatched over seeds.

    `note` is the structure (`ShapeDtypeStruct`s) of what `annotate` keeps of one step.
    """

    note: Any
    init: InitFn
    annotate: AnnotateFn
    reward: RewardFn
    update: UpdateFn
    return_range: ReturnRangeFn


class Stream(NamedTuple):
    """Episodic returns in the reward that is trained on, as it was when the steps were made: what the next-Q clip needs.

    Attributes:
      episode_return: of the current episodes, bonus included; -inf in those that began before learning did: what an untrained
        network pays would raise `highest` for ever.
      highest: of the finished episodes, -inf before the first that counts.
    """

    episode_return: Float[Array, "S E"]
    highest: Float[Array, ""]

    @classmethod
    def start(cls, shape: tuple[int, int]) -> Stream:
        """Before the first step of S x E environments."""
        return cls(jnp.full(shape, -jnp.inf), jnp.float32(-jnp.inf))

    def step(self, reward: Float[Array, "S E"], done: Bool[Array, "S E"], *, learning: Bool[Array, ""]) -> Stream:
        """After a step that paid `reward`, bonus included; `learning` says whether an episode that begins after it counts."""
        episode_return = self.episode_return + reward
        highest = jnp.max(episode_return, initial=-jnp.inf, where=done)
        fresh = jnp.where(learning, 0.0, -jnp.inf)
        return Stream(jnp.where(done, fresh, episode_return), jnp.maximum(self.highest, highest))

    def bounds(self, replay: Replay) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """What the next values are clipped to: above by `highest`, unbounded before the first episode that counts.

        Not below what the environment paid for any episode, the warm-up's too, since a bonus is never negative.  Below by the
        lowest of these, since a discounted value may lie below every undiscounted return with bonuses in it.
        """
        low, paid = replay.returns.bounds()
        return low, jnp.where(jnp.isneginf(self.highest), jnp.inf, jnp.maximum(self.highest, paid))


def pay(batch: Batch, bonus: Float[Array, "..."]) -> tuple[Float[Array, "..."], Metrics]:
    """Both rewards together, and each alone as a metric."""
    metrics = {"extrinsic_reward": jnp.mean(batch.reward), "intrinsic_reward": jnp.mean(bonus)}
    return batch.reward + bonus, metrics


def sample(
    space: TaskSpace, config: Config, replay: Replay, key: Key[Array, ""], iteration: Int[Array, ""]
) -> tuple[Obs, Integer[Array, "B"], Obs]:
    """Observation, action and next observation of `model_batch_size` steps of all sources; consumes `key`."""
    batch = sample_transitions(
        replay,
        key,
        iteration,
        batches=1,
        batch_size=config.model_batch_size,
        n_step=1,
        gamma=1.0,
        success_share=0.0,
        horizon=space.horizon,
    )
    obs, next_obs = ({name: block[0] for name, block in side.items()} for side in (batch.obs, batch.next_obs))
    return obs, batch.action[0], next_obs


def leading(states: Any) -> tuple[int, int]:
    """Sources and environments of states with leaves [S, E, ...]."""
    sources, envs = jax.tree.leaves(states)[0].shape[:2]
    return sources, envs
