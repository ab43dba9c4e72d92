"""What bonuses that learn have in common: networks that descend a loss on replayed steps, and price steps as they are today."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Integer, Key

from apt_jax.bonuses.base import Bonus, Step, Steps
from apt_jax.config import Config, HParams
from apt_jax.descent import ADAM, adam_step, has_learned
from apt_jax.plugin import Metrics
from apt_jax.replay import Batch, Replay, sample_transitions
from apt_jax.specs import Obs
from apt_jax.task_space import TaskSpace


class Moves(NamedTuple):
    """Steps to learn from: the `model_batch_size` = B of one update, of all sources."""

    obs: Obs
    action: Integer[Array, "B"]
    next_obs: Obs


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


class LearnedState(NamedTuple):
    """The state of a bonus that learns.

    Attributes:
      params: what descends the loss.
      opt_state: Adam's.
      memory: whatever else the bonus keeps: fixed networks, running statistics, visits.
      stream: the returns it has led to.
    """

    params: Any
    opt_state: Any
    memory: Any
    stream: Stream


@runtime_checkable
class StartFn(Protocol):
    """`init(key, states) -> (params, memory)`, for the environments' first states (leaves [S, E, ...]); consumes `key`."""

    def __call__(self, key: Key[Array, ""], states: Any) -> tuple[Any, Any]: ...


@runtime_checkable
class ObserveFn(Protocol):
    """`observe(params, memory, step, learning) -> (memory, note)`: when steps are made; `learning` once an update was."""

    def __call__(self, params: Any, memory: Any, step: Step, learning: Bool[Array, ""]) -> tuple[Any, Any]: ...


@runtime_checkable
class PriceFn(Protocol):
    """`price(params, memory, steps, hparams) -> bonus`, at least 0, for any leading axes."""

    def __call__(self, params: Any, memory: Any, steps: Steps, hparams: HParams) -> Float[Array, "..."]: ...


@runtime_checkable
class LossFn(Protocol):
    """`loss(params, memory, moves) -> (loss, metrics)`."""

    def __call__(self, params: Any, memory: Any, moves: Moves) -> tuple[Float[Array, ""], Metrics]: ...


def learned(
    space: TaskSpace, config: Config, *, note: Any, init: StartFn, observe: ObserveFn, price: PriceFn, loss: LossFn
) -> Bonus:
    """The bonus `price`, whose `params` descend `loss` by Adam at `HParams.bonus_learning_rate`.

    Args:
      note: the structure of what `observe` keeps of one step.
    """

    def start(key: Key[Array, ""], states: Any, hparams: HParams) -> LearnedState:
        del hparams
        params, memory = init(key, states)
        return LearnedState(params, ADAM.init(params), memory, Stream.start(leading(states)))

    def annotate(state: LearnedState, step: Step, hparams: HParams) -> tuple[LearnedState, Any]:
        learning = has_learned(state.opt_state)
        memory, noted = observe(state.params, state.memory, step, learning)
        transition = step.transition._replace(note=noted)
        paid = transition.reward + price(state.params, memory, transition, hparams)
        stream = state.stream.step(paid, transition.done, learning=learning)
        return state._replace(memory=memory, stream=stream), noted

    def reward(state: LearnedState, batch: Batch, hparams: HParams) -> tuple[Float[Array, "..."], Metrics]:
        bonus = price(state.params, state.memory, batch, hparams)
        metrics = {"extrinsic_reward": jnp.mean(batch.reward), "intrinsic_reward": jnp.mean(bonus)}
        return batch.reward + bonus, metrics

    def update(
        state: LearnedState, key: Key[Array, ""], replay: Replay, iteration: Int[Array, ""], hparams: HParams
    ) -> tuple[LearnedState, Metrics]:
        moves = _sample(space, config, replay, key, iteration)
        grads, metrics = jax.grad(loss, has_aux=True)(state.params, state.memory, moves)
        params, opt_state = adam_step(state.params, state.opt_state, grads, hparams.bonus_learning_rate)
        return state._replace(params=params, opt_state=opt_state), metrics

    def return_range(state: LearnedState, replay: Replay) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return state.stream.bounds(replay)

    return Bonus(note, start, annotate, reward, update, return_range)


def _sample(space: TaskSpace, config: Config, replay: Replay, key: Key[Array, ""], iteration: Int[Array, ""]) -> Moves:
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
    return Moves(obs, batch.action[0], next_obs)


def leading(states: Any) -> tuple[int, int]:
    """Sources and environments of states with leaves [S, E, ...]."""
    sources, envs = jax.tree.leaves(states)[0].shape[:2]
    return sources, envs
