"""The interface of a bonus: a reward of the agent's own making, added to what the environment pays.

Replay keeps what the environment paid.  The bonus of a step is recomputed from today's networks whenever the step is sampled;
only what cannot be recomputed later is noted down when it is made.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float, Integer, Key

from apt_jax.config import HParams
from apt_jax.plugin import Metrics, UpdateFn
from apt_jax.replay import Batch, Replay, Transition
from apt_jax.specs import Obs


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
