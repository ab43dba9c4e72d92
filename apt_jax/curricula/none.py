"""No curriculum: the policy learns on the target alone."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Key

from apt_jax.config import Config, HParams
from apt_jax.curricula.base import Curriculum, no_refresh, no_report
from apt_jax.plugin import no_update
from apt_jax.specs import Params
from apt_jax.task_space import TaskSpace


def make(space: TaskSpace, config: Config) -> Curriculum:
    """The null plug-in: there is no generated source."""
    del space, config

    def init(key: Key[Array, ""], hparams: HParams) -> Any:
        del key, hparams
        return ()

    def propose(state: Any, key: Key[Array, ""], n: int, hparams: HParams) -> Params:
        raise ValueError("without a curriculum no tasks are generated")

    return Curriculum(False, init, propose, no_update, no_refresh, no_report)
