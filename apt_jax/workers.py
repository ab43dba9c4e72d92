"""Environments that collect experience: step, and start a fresh episode where one ended.  Axes: S sources, E environments."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Integer, Key

from apt_jax.replay import Episode, Transition
from apt_jax.specs import Obs, Params, param_struct, zeros_like
from apt_jax.task_space import StepOutput, TaskSpace, over_environments


class Workers(NamedTuple):
    """Environments in the middle of their episodes; leaves [S, E, ...].

    `w` is the parameter of the current task: zeros for the target, and without leaves where nothing is generated.  `played`
    counts the episodes finished on it; `length`, `episode_return` and `success` (at any step) are those of the current episode.
    """

    state: Any
    obs: Obs
    task: Any
    w: Params
    played: Int[Array, "S E"]
    length: Int[Array, "S E"]
    episode_return: Float[Array, "S E"]
    success: Bool[Array, "S E"]


class Assignment(NamedTuple):
    """Tasks for environments about to reset, with their parameters; leaves [S, E, ...]."""

    task: Any
    w: Params


def assign(space: TaskSpace, target: Any, w: Params | None, envs: int) -> Assignment:
    """The target for source 0 and, if there is a generated source, tasks of `w` (leaves [E, ...]) for source 1."""
    targets = jax.tree.map(lambda x: jnp.broadcast_to(x, (1, envs, *jnp.shape(x))), target)
    if w is None:
        return Assignment(targets, {})
    no_w = zeros_like(param_struct(space.param_spec), (1, envs))
    generated = Assignment(jax.vmap(space.instantiate)(w), w)
    stacked = jax.tree.map(lambda x: x[None], generated)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), Assignment(targets, no_w), stacked)


def start(space: TaskSpace, assignment: Assignment, key: Key[Array, ""]) -> Workers:
    """All environments at the beginning of an episode; consumes `key`."""
    shape = jax.tree.leaves(assignment.task)[0].shape[:2]
    state, obs = over_environments(space.reset)(jax.random.split(key, shape), assignment.task)
    return Workers(
        state=state,
        obs=obs,
        task=assignment.task,
        w=assignment.w,
        played=jnp.zeros(shape, jnp.int32),
        length=jnp.zeros(shape, jnp.int32),
        episode_return=jnp.zeros(shape),
        success=jnp.zeros(shape, bool),
    )


def step(
    space: TaskSpace,
    workers: Workers,
    action: Integer[Array, "S E"],
    assignment: Assignment,
    iteration: Int[Array, ""],
    key: Key[Array, ""],
    *,
    rollouts: int = 1,
) -> tuple[Workers, Transition, Any, Episode, Bool[Array, "S E"]]:
    """Step every environment; where its episode ends, at the latest after `space.horizon` steps, reset it into its assigned
    task; consumes `key`.

    Args:
      action: in [0, num_actions).
      iteration: under which the step will be written to the replay.
      rollouts: episodes that a task is played for before an assignment replaces it.

    Returns:
      The workers after the reset, the transitions with their true final observations, the true final states, the episodes as
      they would end with this step, and which of them did.

    Raises:
      ValueError: while traced, if the space's step returns no `StepOutput`, or a state, observations, a reward or flags of
        another shape or dtype.
    """
    out = over_environments(space.step)(workers.state, action, workers.task)
    if not isinstance(out, StepOutput):
        raise ValueError(f"{space.name}.step must return a StepOutput, got {type(out).__name__}")
    _check_like(out.state, workers.state, f"{space.name}.step must return a state like reset")
    _check_like(out.obs, workers.obs, f"{space.name}.step must return observations like reset")
    _check_like(out.reward, workers.episode_return, f"{space.name}.step must return a float32 reward")
    for name in ("terminated", "truncated", "success"):
        _check_like(getattr(out, name), workers.success, f"{space.name}.step must return {name} as a bool")
    length = workers.length + 1
    done = out.terminated | out.truncated | (length >= space.horizon)
    episode_return = workers.episode_return + out.reward
    transition = Transition(workers.obs, action, out.reward, out.obs, out.terminated, done)
    env = jnp.broadcast_to(jnp.arange(done.shape[1], dtype=jnp.int32), done.shape)
    end = jnp.broadcast_to(iteration, done.shape)
    success = workers.success | out.success
    episode = Episode(workers.w, env, end, length, episode_return, success)

    going_on = workers._replace(state=out.state, obs=out.obs, length=length, episode_return=episode_return, success=success)
    if rollouts == 1:
        fresh = start(space, assignment, key)
    else:
        played = workers.played + 1
        again = played < rollouts
        assignment = _where(again, Assignment(workers.task, workers.w), assignment)
        fresh = start(space, assignment, key)._replace(played=jnp.where(again, played, 0))
    return _where(done, fresh, going_on), transition, out.state, episode, done


def _check_like(given: Any, expected: Any, message: str) -> None:
    """Raises a ValueError where shapes or dtypes differ: the replay would cast in silence."""
    structs = [jax.tree.map(lambda x: (x.shape, x.dtype.name), tree) for tree in (given, expected)]
    if structs[0] != structs[1]:
        raise ValueError(f"{message}, {structs[1]}, got {structs[0]} (shapes with the axes of sources and environments)")


def _where(condition: Bool[Array, "S E"], new: Any, old: Any) -> Any:
    """Leaves [S, E, ...] of either tree."""

    def select(new: Array, old: Array) -> Array:
        return jnp.where(condition.reshape(*condition.shape, *(1,) * (new.ndim - 2)), new, old)

    return jax.tree.map(select, new, old)
