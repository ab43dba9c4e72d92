"""No bonus: the environment's reward alone."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float, Key

from apt_jax.bonuses.base import Bonus, Step
from apt_jax.config import Config, HParams
from apt_jax.plugin import Metrics, no_update
from apt_jax.replay import Batch, Replay
from apt_jax.task_space import TaskSpace


def make(space: TaskSpace, config: Config) -> Bonus:
    """The null plug-in: its state and notes are empty, and it computes nothing."""
    del space, config

    def init(key: Key[Array, ""], states: Any, hparams: HParams) -> Any:
        del key, states, hparams
        return ()

    def annotate(state: Any, step: Step, hparams: HParams) -> tuple[Any, Any]:
        del step, hparams
        return state, ()

    def reward(state: Any, batch: Batch, hparams: HParams) -> tuple[Float[Array, "..."], Metrics]:
        del state, hparams
        return batch.reward, {}

    def return_range(state: Any, replay: Replay) -> tuple[Float[Array, ""], Float[Array, ""]]:
        del state
        return replay.returns.bounds()

    return Bonus((), init, annotate, reward, no_update, return_range)
