"""The protocol every task space fulfils; the trainer knows task spaces through it alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
from jaxtyping import Array, Bool, Float, Int, Integer, Key

from apt_jax import draws
from apt_jax.specs import Obs, Params, Spec, Vector, param_struct


class StepOutput(NamedTuple):
    """What one environment step returns; no field is batched.

    `obs` is the true observation after the step, also at an episode's end: the caller resets.  `terminated` (the MDP ended, no
    bootstrap) and `truncated` (the horizon was reached, bootstrap) are never both true.  An episode is a success if `success`
    is true at any of its steps.
    """

    state: Any
    obs: Obs
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    success: Bool[Array, ""]


@runtime_checkable
class TaskSpace(Protocol):
    """A parameterised family of tasks sharing observations, actions and horizon (paper, Sec. 3.1).

    `w` (learned parameters, described by `param_spec`) and `task` (a concrete MDP, any pytree of arrays) are different types,
    because a target may lie outside the space: a target is a task.  All methods are pure, jittable and unbatched.

    Attributes:
      name: what messages and files call it.
      obs_spec: modalities of an observation.
      param_spec: modalities of `w`.
      num_actions: discrete actions, at most 256.
      horizon: steps after which an episode is over at the latest; where `step` does not end it, it is truncated.
    """

    name: str
    obs_spec: Spec
    param_spec: Spec
    num_actions: int
    horizon: int

    def sample_uniform(self, key: Key[Array, ""]) -> Params:
        """A task parameter drawn uniformly, as by `sample_uniform` below; consumes `key`."""
        ...

    def instantiate(self, w: Params) -> Any:
        """The black-box procedural generation module M(w): the task of a parameter."""
        ...

    def reset(self, key: Key[Array, ""], task: Any) -> tuple[Any, Obs]:
        """An initial state of a task and its observation; consumes `key`."""
        ...

    def step(self, state: Any, action: Integer[Array, ""], task: Any) -> StepOutput:
        """One step with an action in [0, num_actions)."""
        ...

    def fingerprint(self, state: Any) -> Int[Array, "k"]:
        """Whole numbers by which visits of a state within an episode are told apart; continuous parts are rounded."""
        ...

    def describe(self, task: Any, target: Any) -> dict[str, Float[Array, ""]]:
        """Scalars worth watching as a curriculum unfolds, of a task alone or beside the target; the space chooses their names.

        Pictures and tables look for `solution_length`, `feasible` and `goal_distance`.  NaN says "not defined for this task";
        means over tasks skip it.
        """
        ...


def sample_uniform(spec: Spec, key: Key[Array, ""]) -> Params:
    """Scores uniform in [0, 1): every category is equally likely.  Numbers uniform in their range.  Consumes `key`."""
    struct = param_struct(spec)
    w = {}
    for (name, modality), key_block in zip(spec.items(), jax.random.split(key, len(spec)), strict=True):
        low, high = (modality.low, modality.high) if isinstance(modality, Vector) else (0.0, 1.0)
        w[name] = low + (high - low) * draws.uniform(key_block, struct[name].shape)
    return w


def over_environments(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of one environment, mapped over sources and environments: leaves [S, E, ...]."""
    return jax.vmap(jax.vmap(function))


def task_struct(space: TaskSpace) -> Any:
    """The shapes and dtypes of a space's tasks, its targets included."""
    return jax.eval_shape(space.instantiate, param_struct(space.param_spec))
