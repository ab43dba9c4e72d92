"""What a trainer refuses before anything is compiled: sizes that do not fit, spaces and targets that break their specs."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from apt_jax.config import Config
from apt_jax.networks.generator import NOISE_LAYERS
from apt_jax.specs import Grid, Spec, Vector, obs_struct, param_struct
from apt_jax.task_space import TaskSpace, task_struct


def check_sizes(config: Config, sources: int, horizon: int, learns: bool) -> None:
    """Check that the sizes of a configuration fit together.

    Raises:
      ValueError: what does not fit, and what is allowed.
    """
    steps = sources * config.envs_per_source
    rounds = config.model_updates_per_step * steps
    longest = horizon * config.envs_per_source
    needed = config.recent_steps + longest
    most = (2**31 - 1) // sources  # places in it are counted in 32 bits

    def require(holds: bool, message: str) -> None:
        if not holds:
            raise ValueError(message)

    for name in ("warmup_steps", "refresh_every", "eval_every"):
        size = getattr(config, name)
        require(
            size > 0 and size % steps == 0,
            f"{name} must be a positive multiple of {steps}, the environment steps of one iteration ({sources} sources of "
            f"envs_per_source={config.envs_per_source}), got {size}",
        )
    require(
        config.eval_every % config.refresh_every == 0,
        f"eval_every must be a multiple of refresh_every={config.refresh_every}, got {config.eval_every}",
    )
    require(
        config.batch_size >= sources and config.batch_size % sources == 0,
        f"batch_size must be a positive multiple of the {sources} sources, got {config.batch_size}",
    )
    drawn = config.success_share * (config.batch_size // sources)
    require(
        0.0 <= config.success_share <= 1.0 and (round(drawn) >= 1 or drawn == 0.0),
        f"success_share must lie in [0, 1] and be 0 or give at least one of {config.batch_size // sources} transitions, "
        f"got {config.success_share:g}",
    )
    require(
        config.warmup_steps >= horizon * steps,
        f"warmup_steps must let every environment finish an episode: at least {horizon * steps}, got {config.warmup_steps}",
    )
    require(
        not learns or (1 <= rounds < math.inf and abs(rounds - round(rounds)) < 1e-6),
        f"model_updates_per_step must give a whole number of updates per iteration of {steps} environment steps ({sources} "
        f"sources of envs_per_source={config.envs_per_source}), got {config.model_updates_per_step:g}, which gives {rounds:g}",
    )
    require(
        not learns or (config.model_batch_size >= 2 and config.model_batch_size % sources == 0),
        f"model_batch_size must be at least 2 and a multiple of the {sources} sources, got {config.model_batch_size}",
    )
    require(
        config.recent_steps >= longest,
        f"recent_steps must hold one horizon of every environment: at least {longest}, got {config.recent_steps}",
    )
    require(
        config.replay_episodes >= max(config.return_window, config.envs_per_source),
        f"replay_episodes must be at least return_window={config.return_window} and envs_per_source={config.envs_per_source}, "
        f"got {config.replay_episodes}",
    )
    require(
        needed <= config.replay_steps <= most and config.replay_steps % config.envs_per_source == 0,
        f"replay_steps must be a multiple of envs_per_source and hold recent_steps and one more horizon: at least {needed}, "
        f"at most {most}, got {config.replay_steps}",
    )


def check_space(space: TaskSpace) -> None:
    """Check that a space draws parameters, and begins with observations, of the shapes and dtypes of its specs.

    Raises:
      ValueError: which method returns something else, and what is expected; more actions, or categories to observe, than the
        replay can store, or no step or action; names of modalities or descriptions that are taken.
    """
    sizes = {"num_actions": space.num_actions} | {
        f"obs_spec[{name!r}].categories": modality.categories
        for name, modality in space.obs_spec.items()
        if not isinstance(modality, Vector)
    }
    for name, size in sizes.items():
        if not 1 <= size <= 256:
            raise ValueError(f"{name} must be in 1 to 256, got {size}")
    if space.horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {space.horizon}")
    _check_names("obs_spec", space.obs_spec)
    _check_names("param_spec", space.param_spec, taken=NOISE_LAYERS)
    key = jax.eval_shape(lambda: jax.random.key(0))
    task = task_struct(space)
    w = jax.eval_shape(space.sample_uniform, key)
    _, obs = jax.eval_shape(space.reset, key, task)
    for name, given, expected in (
        ("sample_uniform must return", w, param_struct(space.param_spec)),
        ("reset must return observations like", obs, obs_struct(space.obs_spec)),
    ):
        if _struct(given) != _struct(expected):
            raise ValueError(f"{space.name}.{name} {expected}, got {given}")
    described = jax.eval_shape(space.describe, task, task)
    for name, value in described.items():
        if value.shape:
            raise ValueError(f"{space.name}.describe must return scalars, got {name} of shape {value.shape}")
    measured = {f"{kind}_{name}" for kind in ("entropy", "spread") for name in space.param_spec}
    if taken := {"return", "success", "logit", *measured} & set(described):
        raise ValueError(f"{space.name}.describe must leave these names to the trainer: {', '.join(sorted(taken))}")


def _check_names(what: str, spec: Spec, taken: frozenset[str] = frozenset()) -> None:
    """Raises a ValueError for modalities that the layers of a network cannot be called by."""
    taken |= {f"{name}_stack" for name, modality in spec.items() if isinstance(modality, Grid)}
    for name in spec:
        if not name.isidentifier() or name in taken:
            raise ValueError(
                f"{what} must name modalities like variables, and none {' or '.join(sorted(taken)) or 'twice'}, got {name!r}"
            )


def check_target(space: TaskSpace, target: Any) -> None:
    """Check that a target is a task of the shapes and dtypes that the space's tasks have.

    Raises:
      ValueError: where it differs.
    """
    expected = _struct(task_struct(space))
    given = _struct(jax.tree.map(jnp.asarray, target))
    if given != expected:
        raise ValueError(f"the target must look like a task of {space.name}, {expected}, got {given}")


def _struct(tree: Any) -> Any:
    """Shapes and dtypes alone: an array also knows whether its dtype is weak and, where it is traced, how it is sharded."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)
