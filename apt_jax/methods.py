"""Every method as a curriculum and a bonus on the same learner, by name."""

from __future__ import annotations

from typing import NamedTuple

from apt_jax.bonuses import BONUSES
from apt_jax.bonuses.base import Bonus
from apt_jax.config import Config
from apt_jax.curricula import CURRICULA
from apt_jax.curricula.base import Curriculum
from apt_jax.registry import look_up
from apt_jax.task_space import TaskSpace


class Method(NamedTuple):
    """Names of a curriculum and a bonus."""

    curriculum: str = "none"
    bonus: str = "none"


METHODS: dict[str, Method] = {
    "apt_gen": Method("apt_gen"),
    "apt_gen_progress_only": Method("apt_gen_progress_only"),
    "apt_gen_return_only": Method("apt_gen_return_only"),
    "random": Method("random"),
    "alp_gmm": Method("alp_gmm"),
    "goal_gan": Method("goal_gan"),
    "dqn": Method(),
    "icm": Method(bonus="icm"),
    "rnd": Method(bonus="rnd"),
    "ride": Method(bonus="ride"),
}
"""The methods of the paper: ours and its ablations, baselines with a curriculum, and baselines on the target alone."""


def parse_method(name: str) -> Method:
    """The method called `name`: one of `METHODS`, or a curriculum by its own name; with a bonus added as in "apt_gen+rnd".

    Raises:
      ValueError: an unknown name, with the closest one, or a second bonus.
    """
    base, plus, bonus = name.partition("+")
    method = look_up({name: Method(name) for name in CURRICULA} | METHODS, base, "method")
    if not plus:
        return method
    if method.bonus != "none":
        raise ValueError(f"method {name!r} has two bonuses, at most one is allowed: {base!r} comes with {method.bonus!r}")
    look_up(BONUSES, bonus, "bonus")
    return method._replace(bonus=bonus)


def make_method(space: TaskSpace, config: Config) -> tuple[Curriculum, Bonus]:
    """The curriculum and the bonus that `config.method` names.

    Raises:
      ValueError: an unknown name, or sizes that its parts cannot work with.
    """
    method = parse_method(config.method)
    curriculum = look_up(CURRICULA, method.curriculum, "curriculum")(space, config)
    bonus = look_up(BONUSES, method.bonus, "bonus")(space, config)
    if method.bonus != "none" and config.n_step != 1:
        raise ValueError(f"n_step must be 1 with the bonus {method.bonus!r}, which pays single steps, got {config.n_step}")
    return curriculum, bonus
