"""Action values of an observation (paper, appendix "Q-Network")."""

from __future__ import annotations

import flax.linen as nn
from jaxtyping import Array, Float

from apt_jax.networks.encoders import Encoder, Head, observation_features
from apt_jax.specs import Obs, Spec


class QNetwork(nn.Module):
    """Modality encoders -> 128 -> one value per action.  Takes any leading batch axes.

    Attributes:
      obs_spec: the observation's modalities.
      num_actions: discrete actions.
    """

    obs_spec: Spec
    num_actions: int

    @nn.compact
    def __call__(self, obs: Obs) -> Float[Array, "*batch num_actions"]:
        encoding = Encoder(self.obs_spec, name="encoder")(observation_features(self.obs_spec, obs))
        return Head(self.num_actions, name="head")(encoding)
