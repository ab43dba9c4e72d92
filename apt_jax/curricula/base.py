"""The interface of a curriculum: which tasks to generate next, and how to learn that from experience."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Int, Key

from apt_jax.config import HParams
from apt_jax.plugin import Metrics, UpdateFn
from apt_jax.replay import Replay, Rollouts
from apt_jax.specs import Params

TARGET, GENERATED = 0, 1
"""Indices of the sources along the leading axis of replay and workers."""


@runtime_checkable
class InitFn(Protocol):
    """`init(key, hparams) -> state`: a pytree of arrays; consumes `key`."""

    def __call__(self, key: Key[Array, ""], hparams: HParams) -> Any: ...


@runtime_checkable
class ProposeFn(Protocol):
    """`propose(state, key, n, hparams) -> w`: `n` task parameters, leaves [n, ...]; consumes `key`."""

    def __call__(self, state: Any, key: Key[Array, ""], n: int, hparams: HParams) -> Params: ...


@runtime_checkable
class RefreshFn(Protocol):
    """`refresh(state, key, replay, iterations, hparams) -> state`: slow adaptation on the cadence `Config.refresh_every`.

    Consumes `key`.  `iterations` is how many there have been, one more than the latest one written to the replay.  It is never
    batched: work that is due less often goes behind a `cond` on it, and on nothing else.
    """

    def __call__(
        self, state: Any, key: Key[Array, ""], replay: Replay, iterations: Int[Array, ""], hparams: HParams
    ) -> Any: ...


@runtime_checkable
class ReportFn(Protocol):
    """`report(state, rollouts, hparams) -> metrics`: judge the state on fresh tasks, played by the averaged policy with
    today's exploration (the online one collects).

    `rollouts` has `Config.probe_tasks` of them, each with as many steps as the horizon, drawn with replacement.
    """

    def __call__(self, state: Any, rollouts: Rollouts, hparams: HParams) -> Metrics: ...


class Curriculum(NamedTuple):
    """A plug-in made of pure functions over an explicit state; unbatched over seeds.

    `generates` is False for the null plug-in, which has no generated source: its `propose` is never called.  `rollouts` is the
    number of episodes that each proposed task is played for.
    """

    generates: bool
    init: InitFn
    propose: ProposeFn
    update: UpdateFn
    refresh: RefreshFn
    report: ReportFn
    rollouts: int = 1


def no_refresh(state: Any, key: Key[Array, ""], replay: Replay, iterations: Int[Array, ""], hparams: HParams) -> Any:
    """The `refresh` of a curriculum that does not adapt."""
    del key, replay, iterations, hparams
    return state


def no_report(state: Any, rollouts: Rollouts, hparams: HParams) -> Metrics:
    """The `report` of a curriculum that has no model of tasks."""
    del state, rollouts, hparams
    return {}
