"""Scores of a rollout's parts, target-like against generated (paper, appendix "Task Discriminator")."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Integer

from apt_jax.networks.encoders import ENCODING_SIZE, Encoder, Head, observation_features
from apt_jax.networks.layers import Dense
from apt_jax.specs import Obs, Spec


class Discriminator(nn.Module):
    """One logit for the initial observation and one per transition; `pool` makes them the rollout's score.

    The initial observation and the transitions have encoders of their own (phi_init, phi_step).  Inside phi_step, s_t and
    s_{t+1} share one encoder, run once on both: the paper leaves that open, and it halves the weights.  Both branches take
    any leading batch axes.

    Attributes:
      obs_spec: the observation's modalities.
      num_actions: discrete actions.
    """

    obs_spec: Spec
    num_actions: int

    def setup(self) -> None:
        self.init_encoder = Encoder(self.obs_spec)
        self.init_head = Head(1)
        self.state_encoder = Encoder(self.obs_spec)
        self.action_encoder = Dense(ENCODING_SIZE)
        self.reward_encoder = Dense(ENCODING_SIZE)
        self.step_head = Head(1)

    def score_init(self, obs: Obs) -> Float[Array, "*batch"]:
        """Logit of the initial observation."""
        return self.init_head(self.init_encoder(observation_features(self.obs_spec, obs))).squeeze(-1)

    def score_step(
        self, obs: Obs, action: Integer[Array, "*batch"], *, reward: Float[Array, "*batch"], next_obs: Obs
    ) -> Float[Array, "*batch"]:
        """Logit of the transition (s_t, a_t, r_t, s_{t+1})."""
        both = jax.tree.map(lambda now, after: jnp.stack([now, after]), obs, next_obs)
        state, next_state = self.state_encoder(observation_features(self.obs_spec, both))
        action_encoding = nn.relu(self.action_encoder(jax.nn.one_hot(action, self.num_actions)))
        reward_encoding = nn.relu(self.reward_encoder(reward[..., None]))
        encoding = jnp.concatenate([state, action_encoding, reward_encoding, next_state], axis=-1)
        return self.step_head(encoding).squeeze(-1)

    def __call__(
        self, obs: Obs, action: Integer[Array, "*batch"], *, reward: Float[Array, "*batch"], next_obs: Obs
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
        """Both logits of a first transition; `init` makes the parameters of both branches by it."""
        return self.score_init(obs), self.score_step(obs, action, reward=reward, next_obs=next_obs)


def pool(
    init_logit: Float[Array, "*batch"], step_logits: Float[Array, "*batch k"], length: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Estimates the average over the initial logit and all `length` step logits from a sample of k of the latter."""
    steps = length.astype(init_logit.dtype)
    return (init_logit + steps * step_logits.mean(axis=-1)) / (1.0 + steps)


def pool_probabilities(init_logit: Float[Array, "*batch"], step_logits: Float[Array, "*batch k"]) -> Float[Array, "*batch"]:
    """Logit of an average of probabilities, half of it the initial observation's, half that of the transitions."""
    probability = 0.5 * (jax.nn.sigmoid(init_logit) + jax.nn.sigmoid(step_logits).mean(axis=-1))
    return jax.scipy.special.logit(jnp.clip(probability, 1e-6, 1.0 - 1e-6))
