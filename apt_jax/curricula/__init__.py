"""Curricula by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from apt_jax.config import Config
from apt_jax.curricula import alp_gmm, apt_gen, goal_gan, none, random
from apt_jax.curricula.base import Curriculum
from apt_jax.task_space import TaskSpace

CURRICULA: dict[str, Callable[[TaskSpace, Config], Curriculum]] = {
    "none": none.make,
    "alp_gmm": alp_gmm.make,
    "apt_gen": apt_gen.make,
    "apt_gen_progress_only": partial(apt_gen.make, return_weight=0.0),
    "apt_gen_return_only": partial(apt_gen.make, progress_weight=0.0),
    "goal_gan": goal_gan.make,
    "random": random.make,
}
