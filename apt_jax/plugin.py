"""What curricula and exploration bonuses have in common."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float, Int, Key

from apt_jax.config import HParams
from apt_jax.replay import Replay

Metrics = dict[str, Float[Array, ""]]


@runtime_checkable
class UpdateFn(Protocol):
    """`update(state, key, replay, iteration, hparams) -> (state, metrics)`: one round of learning; consumes `key`.

    `iteration` is the latest one written to the replay.
    """

    def __call__(
        self, state: Any, key: Key[Array, ""], replay: Replay, iteration: Int[Array, ""], hparams: HParams
    ) -> tuple[Any, Metrics]: ...


def no_update(
    state: Any, key: Key[Array, ""], replay: Replay, iteration: Int[Array, ""], hparams: HParams
) -> tuple[Any, Metrics]:
    """The `update` of a plug-in that does not learn."""
    del key, replay, iteration, hparams
    return state, {}
