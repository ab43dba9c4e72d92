"""Curricula by name."""

from __future__ import annotations

from collections.abc import Callable

from apt_jax.config import Config
from apt_jax.curricula import apt_gen, random, target_only
from apt_jax.curricula.base import Curriculum
from apt_jax.registry import look_up
from apt_jax.task_space import TaskSpace

METHODS: dict[str, Callable[[TaskSpace, Config], Curriculum]] = {
    "apt_gen": apt_gen.make,
    "random": random.make,
    "target_only": target_only.make,
}


def make_curriculum(space: TaskSpace, config: Config) -> Curriculum:
    """The curriculum `config.method` names.

    Raises:
      ValueError: an unknown name; the message holds the closest ones.
    """
    return look_up(METHODS, config.method, "method")(space, config)
