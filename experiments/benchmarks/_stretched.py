"""A task space with another horizon and a longer parameter, to see what these cost."""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, Int, Key

from apt_jax.specs import Params, Spec, Vector, param_struct
from apt_jax.task_space import StepOutput, TaskSpace


class Stretched:
    """Tasks, rules and rewards are those of `space`, whose states count their `steps`.

    Args:
      horizon: steps after which an episode is cut off instead.
      more: numbers added to the parameter, which mean nothing.
    """

    def __init__(self, space: TaskSpace, *, horizon: int, more: int) -> None:
        self._space = space
        self.name: str = space.name
        self.obs_spec: Spec = space.obs_spec
        self._more: Spec = {"more": Vector(more, 0.0, 1.0)} if more else {}
        self.param_spec: Spec = {**space.param_spec, **self._more}
        self.num_actions: int = space.num_actions
        self.horizon: int = horizon
        self.reset = space.reset
        self.fingerprint = space.fingerprint
        self.describe = space.describe

    def sample_uniform(self, key: Key[Array, ""]) -> Params:
        """A task parameter drawn uniformly; consumes `key`."""
        key_space, key_more = jax.random.split(key)
        more = {name: jax.random.uniform(key_more, block.shape) for name, block in param_struct(self._more).items()}
        return {**self._space.sample_uniform(key_space), **more}

    def instantiate(self, w: Params) -> Any:
        """The task of a parameter."""
        return self._space.instantiate({name: w[name] for name in self._space.param_spec})

    def step(self, state: Any, action: Int[Array, ""], task: Any) -> StepOutput:
        """One step with an action in [0, num_actions)."""
        out = self._space.step(state, action, task)
        return out._replace(truncated=~out.terminated & (out.state.steps >= self.horizon))
