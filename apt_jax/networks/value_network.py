"""A number predicted from a task parameter: task progress (V1) or expected return (V2) (paper, appendix "Value Networks")."""

from __future__ import annotations

import flax.linen as nn
from jaxtyping import Array, Float

from apt_jax.networks.encoders import Encoder, Head, parameter_features
from apt_jax.specs import Params, Spec


class ValueNetwork(nn.Module):
    """The discriminator's initial-state branch with `w` as its input: w -> [...].  Takes any leading batch axes.

    Attributes:
      param_spec: the task parameter's modalities.
    """

    param_spec: Spec

    @nn.compact
    def __call__(self, w: Params) -> Float[Array, "*batch"]:
        encoding = Encoder(self.param_spec, name="encoder")(parameter_features(self.param_spec, w))
        return Head(1, name="head")(encoding).squeeze(-1)
