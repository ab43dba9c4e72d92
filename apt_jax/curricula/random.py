"""Tasks drawn uniformly from the task space (the paper's baseline "Random")."""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, Key

from apt_jax.config import Config, HParams
from apt_jax.curricula.base import Curriculum, no_refresh, no_report
from apt_jax.plugin import no_update
from apt_jax.specs import Params
from apt_jax.task_space import TaskSpace


def make(space: TaskSpace, config: Config) -> Curriculum:
    """Uniform over task parameters, whatever the agent has learned."""
    del config

    def init(key: Key[Array, ""], hparams: HParams) -> Any:
        del key, hparams
        return ()

    def propose(state: Any, key: Key[Array, ""], n: int, hparams: HParams) -> Params:
        del state, hparams
        return jax.vmap(space.sample_uniform)(jax.random.split(key, n))

    return Curriculum(True, init, propose, no_update, no_refresh, no_report)
