"""A fixed random function of a state and a network that learns it, for intrinsic rewards (Burda et al. 2019)."""

from __future__ import annotations

import flax.linen as nn
from jaxtyping import Array, Float

from apt_jax.networks.encoders import MERGE_SIZE, Encoder, Features, Head
from apt_jax.networks.layers import Dense
from apt_jax.specs import Spec


class Distillation(nn.Module):
    """Target (`deeper` False) or predictor, which has two more hidden layers: features -> [..., 128].

    Attributes:
      obs_spec: the observation's modalities.
      deeper: whether this is the predictor.
    """

    obs_spec: Spec
    deeper: bool

    @nn.compact
    def __call__(self, features: Features) -> Float[Array, "*batch 128"]:
        x = Head(MERGE_SIZE, name="head")(Encoder(self.obs_spec, name="encoder")(features))
        for _ in range(2 if self.deeper else 0):
            x = Dense(MERGE_SIZE)(nn.relu(x))
        return x
