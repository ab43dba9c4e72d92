"""The losses of the paper, unbatched or over one batch, each free of state."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer


def td_target(
    *,
    reward: Float[Array, "B"],
    discount: Float[Array, "B"],
    next_q_selector: Float[Array, "B A"],
    next_q_value: Float[Array, "B A"],
    low: Float[Array, ""] | float,
    high: Float[Array, ""] | float,
) -> Float[Array, "B"]:
    """Double Q-learning target with the next-Q clip (paper, appendix "Stability").

    The selector's argmax picks the action, its value is clipped to [`low`, `high`], the range of episodic returns, and only
    then discounted: it is the bootstrap that is clipped, not the target.  `discount` is 0 after a termination; a truncated step
    bootstraps like any other.
    """
    action = jnp.argmax(next_q_selector, axis=-1)
    bootstrap = jnp.take_along_axis(next_q_value, action[:, None], axis=-1)[:, 0]
    return reward + discount * jnp.clip(bootstrap, low, high)


def td_errors(q: Float[Array, "B A"], action: Integer[Array, "B"], target: Float[Array, "B"]) -> Float[Array, "B"]:
    """Target minus the value of the action taken."""
    return target - jnp.take_along_axis(q, action[:, None].astype(jnp.int32), axis=-1)[:, 0]


def discriminator_loss(target_logit: Float[Array, "*B"], generated_logit: Float[Array, "*B"]) -> Float[Array, ""]:
    """Binary cross-entropy of telling target rollouts, or parts of them, from generated ones (paper, Eq. 4).

    The paper prints the second term as 1 - log D, which is unbounded below and pushes hardest where D is already right; this
    is the standard -log(1 - D) of the cited GAN loss.
    """
    return jnp.mean(jax.nn.softplus(-target_logit)) + jnp.mean(jax.nn.softplus(generated_logit))


def generator_objective(
    progress: Float[Array, "B"], value: Float[Array, "B"], *, beta: Float[Array, ""] | float, delta: Float[Array, ""] | float
) -> Float[Array, ""]:
    """E_z[V1(G(z)) + beta (V2(G(z)) - delta)], to be maximised (paper, Eq. 3)."""
    return jnp.mean(progress + beta * (value - delta))


def lsgan_discriminator_loss(
    label: Float[Array, "B"], score: Float[Array, "B"], generated_score: Float[Array, "n"]
) -> Float[Array, ""]:
    """Least-squares GAN on labelled samples (Held et al. 2018, Eq. 4): 1 is wanted of those with label 1, -1 of all others."""
    errors = jnp.concatenate([2.0 * label - 1.0 - score, -1.0 - generated_score])
    return jnp.mean(errors**2)


def lsgan_generator_loss(generated_score: Float[Array, "n"], *, wanted: float = 1.0) -> Float[Array, ""]:
    """Pulls generated samples to the score `wanted`: 1 in public implementations of GoalGAN, 0 in its paper."""
    return jnp.mean((generated_score - wanted) ** 2)


def adapt_beta(
    beta: Float[Array, ""],
    episode_return: Float[Array, ""],
    *,
    delta: Float[Array, ""] | float,
    tolerance: Float[Array, ""] | float,
    low: Float[Array, ""] | float,
    high: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Double beta below delta - tolerance, halve it above delta + tolerance, within [`low`, `high`] (paper, appendix).

    A NaN return (no finished episode) leaves beta as it is.
    """
    doubled = jnp.minimum(beta * 2.0, high)
    halved = jnp.maximum(beta / 2.0, low)
    return jnp.where(episode_return < delta - tolerance, doubled, jnp.where(episode_return > delta + tolerance, halved, beta))


def proportional_beta(
    beta: Float[Array, ""],
    episode_return: Float[Array, ""],
    *,
    neutral: Float[Array, ""] | float,
    delta: Float[Array, ""] | float,
    tolerance: Float[Array, ""] | float,
    low: Float[Array, ""] | float,
    high: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """`neutral` at `delta`, twice as much for every `tolerance` that the return is below it, within [`low`, `high`].

    The generator sums up what beta tells it: how hard tasks are follows beta's integral.  The paper's rule is a second integral
    on top, which overshoots; this one adds none.  A NaN return (no finished episode) leaves beta as it is.
    """
    wanted = jnp.clip(neutral * jnp.exp2((delta - episode_return) / jnp.maximum(tolerance, 1e-6)), low, high)
    return jnp.where(jnp.isnan(episode_return), beta, wanted)
