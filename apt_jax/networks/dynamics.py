"""A state embedding learned from what actions do, for intrinsic rewards (Pathak et al. 2017)."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer

from apt_jax.networks.encoders import MERGE_SIZE, Encoder, Head, observation_features
from apt_jax.specs import Obs, Spec


class Dynamics(nn.Module):
    """An embedding phi(s), the action guessed from phi(s) and phi(s'), and phi(s') predicted from phi(s) and the action.

    The encoder is the Q-network's, every hidden layer as wide as its last one.  All methods take any leading batch axes.

    Attributes:
      obs_spec: the observation's modalities.
      num_actions: discrete actions.
    """

    obs_spec: Spec
    num_actions: int

    def setup(self) -> None:
        self.encoder = Encoder(self.obs_spec)
        self.embedding = Head(MERGE_SIZE)
        self.inverse_head = Head(self.num_actions)
        self.forward_head = Head(MERGE_SIZE)

    def embed(self, obs: Obs) -> Float[Array, "*batch 128"]:
        """phi(s)."""
        return self.embedding(self.encoder(observation_features(self.obs_spec, obs)))

    def infer_action(self, phi: Float[Array, "*batch 128"], next_phi: Float[Array, "*batch 128"]) -> Float[Array, "*batch A"]:
        """Logits of the action between two states."""
        return self.inverse_head(jnp.concatenate([phi, next_phi], axis=-1))

    def predict(self, phi: Float[Array, "*batch 128"], action: Integer[Array, "*batch"]) -> Float[Array, "*batch 128"]:
        """The embedding after an action."""
        return self.forward_head(jnp.concatenate([phi, jax.nn.one_hot(action, self.num_actions)], axis=-1))

    def __call__(
        self, obs: Obs, action: Integer[Array, "*batch"], next_obs: Obs, *, detach: bool
    ) -> tuple[Float[Array, "*batch A"], Float[Array, "*batch 128"], Float[Array, "*batch 128"]]:
        """Action logits, predicted and true embedding of s'; `init` makes all parameters by it.

        Args:
          detach: whether the embeddings learn nothing from how well they can be predicted.
        """
        phi, next_phi = self.embed(obs), self.embed(next_obs)
        logits = self.infer_action(phi, next_phi)
        if detach:
            phi, next_phi = jax.lax.stop_gradient((phi, next_phi))
        return logits, self.predict(phi, action), next_phi
