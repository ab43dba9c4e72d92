"""Intrinsic rewards by name."""

from __future__ import annotations

from collections.abc import Callable

from apt_jax.bonuses import icm, none, ride, rnd
from apt_jax.bonuses.base import Bonus
from apt_jax.config import Config
from apt_jax.task_space import TaskSpace

BONUSES: dict[str, Callable[[TaskSpace, Config], Bonus]] = {
    "none": none.make,
    "icm": icm.make,
    "ride": ride.make,
    "rnd": rnd.make,
}
