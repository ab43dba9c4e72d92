"""ICM: paid for what the agent cannot predict (Pathak et al. 2017)."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Bool, Float, Key

from apt_jax.bonuses.base import Bonus, Step, Steps
from apt_jax.bonuses.embedding import dynamics_loss, init_dynamics, prediction_error
from apt_jax.bonuses.learned import learned
from apt_jax.config import Config, HParams
from apt_jax.networks import Dynamics
from apt_jax.networks.apply import apply
from apt_jax.task_space import TaskSpace


def make(space: TaskSpace, config: Config) -> Bonus:
    """Half the squared error of the predicted embedding, times `HParams.icm_scale`.

    The embedding learns from the inverse loss alone, the forward model from the other: they share no parameter, so the paper's
    weights of the two (0.8 and 0.2) would change nothing under Adam.
    """
    network = Dynamics(space.obs_spec, space.num_actions)
    loss = dynamics_loss(network, "icm", inverse_weight=1.0, forward_weight=1.0, detach=True)

    def init(key: Key[Array, ""], states: Any) -> tuple[Any, Any]:
        del states
        return init_dynamics(network, key), ()

    def observe(params: Any, memory: Any, step: Step, learning: Bool[Array, ""]) -> tuple[Any, Any]:
        del params, step, learning
        return memory, ()

    def price(params: Any, memory: Any, steps: Steps, hparams: HParams) -> Float[Array, "..."]:
        del memory
        _, predicted, embedding = apply(network, params, steps.obs, steps.action, steps.next_obs, detach=True)
        return hparams.icm_scale * prediction_error(predicted, embedding)

    return learned(space, config, note=(), init=init, observe=observe, price=price, loss=loss)
