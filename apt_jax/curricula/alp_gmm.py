"""ALP-GMM: tasks where the agent's return changes most (Portelas et al. 2019).

Absolute learning progress (ALP) of an episode is how far its return lies from that of the nearest earlier task.  Mixtures are
fitted to the latest tasks with their progress, and tasks are drawn from components in proportion to the progress there.

In many dimensions that is a weak guide: a full covariance of Grid-World's 202 numbers and the progress has 20,706 entries, to
be told from 250 episodes.  The weakness is the method's own.
"""

from __future__ import annotations

from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from apt_jax import replay as rp
from apt_jax.config import Config, Covariance, HParams
from apt_jax.curricula.base import GENERATED, Curriculum
from apt_jax.curricula.mixture import Mixture, draw, fit, k_means
from apt_jax.plugin import Metrics, no_update
from apt_jax.specs import Params, block_weights, flatten, unflatten
from apt_jax.task_space import TaskSpace

MOST_COMPONENTS = 10
COMPONENTS = range(2, MOST_COMPONENTS + 1)
"""Numbers of components that are tried; the lowest AIC wins."""

LEAST_HISTORY = 5
"""Up to so many earlier episodes tell nothing: progress is 0."""


class AlpGmmState(NamedTuple):
    """The mixture of (task, progress), how many of its slots are in use (0 before the first fit), and the mean progress."""

    mixture: Mixture
    components: Int[Array, ""]
    mean_progress: Float[Array, ""]


def make(space: TaskSpace, config: Config) -> Curriculum:
    """Mixtures over the flattened task parameter, every block scaled to weigh the same.

    Raises:
      ValueError: a window with its history that the replay does not hold, a fit that is due between two refreshes, or an
        unknown covariance.
    """
    if config.replay_episodes < config.alp_window + config.alp_history:
        raise ValueError(
            f"alp_window and alp_history must sum to at most replay_episodes={config.replay_episodes}, "
            f"got {config.alp_window} and {config.alp_history}"
        )
    if config.alp_covariance not in get_args(Covariance):
        raise ValueError(f"alp_covariance must be one of {', '.join(get_args(Covariance))}, got {config.alp_covariance!r}")
    if config.alp_fit_every < 1 or config.alp_fit_every % config.refresh_every:
        raise ValueError(
            f"alp_fit_every must be a positive multiple of refresh_every={config.refresh_every}, got {config.alp_fit_every}"
        )
    scale = block_weights(space.param_spec)
    size = scale.size + 1
    steps = 2 * config.envs_per_source

    def init(key: Key[Array, ""], hparams: HParams) -> AlpGmmState:
        del key, hparams
        slots = MOST_COMPONENTS
        mixture = Mixture(jnp.zeros(slots), jnp.zeros((slots, size)), jnp.zeros((slots, size, size)))
        return AlpGmmState(mixture, jnp.int32(0), jnp.float32(0.0))

    def propose(state: AlpGmmState, key: Key[Array, ""], n: int, hparams: HParams) -> Params:
        key_uniform, key_choice, key_mixture = jax.random.split(key, 3)
        logits = component_logits(state.mixture.means[:, -1], state.components)
        rows = jax.vmap(lambda key: draw(state.mixture, logits, key))(jax.random.split(key_mixture, n))
        drawn = unflatten(space.param_spec, rows[:, :-1] / scale[None, :])
        uniform = jax.vmap(space.sample_uniform)(jax.random.split(key_uniform, n))
        explores = (state.components == 0) | (jax.random.uniform(key_choice, (n,)) < hparams.alp_random_share)
        return jax.tree.map(lambda u, d: jnp.where(explores.reshape(n, *(1,) * (d.ndim - 1)), u, d), uniform, drawn)

    def refit(state: AlpGmmState, key: Key[Array, ""], replay: rp.Replay, hparams: HParams) -> AlpGmmState:
        episodes, earlier = rp.latest_episodes(replay, source=GENERATED, count=config.alp_window + config.alp_history)
        w = flatten(space.param_spec, episodes.w) * scale[None, :]
        progress = learning_progress(w, episodes.episode_return, earlier, window=config.alp_window)
        rows = jnp.concatenate([w[: config.alp_window], progress[:, None]], axis=1)
        valid = earlier[: config.alp_window] >= 0

        def fitted(k: Int[Array, ""]) -> tuple[Mixture, Float[Array, ""]]:
            labels = k_means(rows, valid, k, jax.random.fold_in(key, k), slots=MOST_COMPONENTS)
            result = fit(
                rows,
                valid,
                labels,
                k,
                slots=MOST_COMPONENTS,
                regularisation=hparams.alp_regularisation,
                diagonal=config.alp_covariance == "diagonal",
            )
            return result.mixture, jnp.where(jnp.isnan(result.aic), jnp.inf, result.aic)

        candidates = jnp.array(COMPONENTS, jnp.int32)
        # One after another: each stops when it has converged, all at once would wait for the slowest.
        mixtures, aic = jax.lax.map(fitted, candidates)
        best = jnp.argmin(aic)
        usable = jnp.all(valid) & jnp.isfinite(aic[best])
        new = AlpGmmState(jax.tree.map(lambda x: x[best], mixtures), candidates[best], jnp.mean(progress))
        return jax.tree.map(lambda a, b: jnp.where(usable, a, b), new, state)

    def refresh(
        state: AlpGmmState, key: Key[Array, ""], replay: rp.Replay, iterations: Int[Array, ""], hparams: HParams
    ) -> AlpGmmState:
        trained = iterations * steps - config.warmup_steps
        return jax.lax.cond(
            trained % config.alp_fit_every == config.refresh_every % config.alp_fit_every,
            lambda: refit(state, key, replay, hparams),
            lambda: state,
        )

    def report(state: AlpGmmState, rollouts: rp.Rollouts, hparams: HParams) -> Metrics:
        del rollouts, hparams
        return {"alp_components": state.components.astype(jnp.float32), "alp_mean_progress": state.mean_progress}

    return Curriculum(True, init, propose, no_update, refresh, report)


def learning_progress(
    w: Float[Array, "n D"], episode_return: Float[Array, "n"], earlier: Int[Array, "n"], *, window: int
) -> Float[Array, "window"]:
    """Absolute learning progress of the newest `window` of n episodes, newest first.

    The distance of an episode's return from that of the nearest task among the n - window episodes before it, the newest one of
    equally near ones; 0 for the very first episodes.

    Args:
      earlier: how many episodes were finished before each, negative where there is no episode.
    """
    history = w.shape[0] - window
    place = jnp.arange(w.shape[0], dtype=jnp.int32)

    def progress(i: Int[Array, ""]) -> Float[Array, ""]:
        known = (place > i) & (place <= i + history) & (earlier >= 0)
        distance = jnp.where(known, jnp.sum((w - w[i][None, :]) ** 2, axis=1), jnp.inf)
        change = jnp.abs(episode_return[i] - episode_return[jnp.argmin(distance)])
        return jnp.where(earlier[i] > LEAST_HISTORY, change, 0.0)

    return jax.lax.map(progress, place[:window])


def component_logits(progress: Float[Array, "K"], components: Int[Array, ""]) -> Float[Array, "K"]:
    """Components in use in proportion to their mean progress, all alike if none has any."""
    used = jnp.arange(progress.shape[0], dtype=jnp.int32) < jnp.maximum(components, 1)
    progress = jnp.where(used, jnp.maximum(progress, 0.0), 0.0)
    progress = jnp.where(jnp.sum(progress) > 0.0, progress, used.astype(jnp.float32))
    return jnp.log(progress)
