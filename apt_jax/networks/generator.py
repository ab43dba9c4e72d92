"""Task parameters from noise (paper, appendix "Task Generator")."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import prod
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from apt_jax.networks.encoders import CHANNELS, ENCODING_SIZE
from apt_jax.networks.layers import Conv, ConvTranspose, Dense
from apt_jax.specs import Grid, Params, Spec, Table, Vector

OUTPUT_NORM = "output_norm"

NOISE_LAYERS = frozenset({"noise", "noise_norm"})
"""Names that no modality can have: `Generator` calls the layers common to all by them."""


class Generator(nn.Module):
    """z [batch, noise_size] -> w, each modality [batch, ...].

    "Batch normalization is used in all layers", here also in the output layers.  With `train=True` the statistics are those
    of the batch, so the batch must be an axis of `z` (a `vmap` over samples would make all outputs equal), hold more than one
    sample, and `batch_stats` must be mutable.  With `train=False` they are the running ones.

    Attributes:
      param_spec: the task parameter's modalities.
      blank_bias: initial bias of a grid's category 0, whose scores have unit spread: of three categories' cells 2 leaves 87 %
        blank.
      momentum: of the running statistics.  0.9 averages about 20 batches and lags 10 updates behind the weights; the lag of
        0.99, 100 updates, costs more than its steadier average gains.
    """

    param_spec: Spec
    blank_bias: float = 0.0
    momentum: float = 0.9

    @nn.compact
    def __call__(self, z: Float[Array, "batch noise"], *, train: bool) -> Params:
        norm = partial(nn.BatchNorm, use_running_average=not train, momentum=self.momentum)
        hidden = Dense(ENCODING_SIZE, use_bias=False, name="noise")(z)
        hidden = nn.relu(norm(name="noise_norm")(hidden))
        w = {}
        for name, modality in self.param_spec.items():
            match modality:
                case Vector():
                    w[name] = VectorHead(modality, norm, name=name)(hidden)
                case Grid():
                    w[name] = GridHead(modality, self.blank_bias, norm, name=name)(hidden)
                case Table():
                    w[name] = TableHead(modality, norm, name=name)(hidden)
        return w


class VectorHead(nn.Module):
    """A sigmoid stretched over the modality's range: [batch, hidden] -> [batch, size]."""

    vector: Vector
    norm: partial[nn.BatchNorm]

    @nn.compact
    def __call__(self, hidden: Float[Array, "batch hidden"]) -> Float[Array, "batch size"]:
        logits = self.norm(name=OUTPUT_NORM)(Dense(self.vector.size, use_bias=False)(hidden))
        return self.vector.low + (self.vector.high - self.vector.low) * nn.sigmoid(logits)


def vector_divergence(spec: Spec, params: Any) -> Float[Array, ""]:
    """How far generated vectors have gone from a fresh generator's: KL(N(bias, scale^2) || N(0, 1)) summed over their numbers.

    Those are the mean and the deviation over z that BatchNorm gives a number before its sigmoid, 0 and 1 at first.  A bias far
    from 0 leaves a number at the end of its range, where the sigmoid is flat and nothing else would bring it back; a scale
    near 0 makes it the same in all tasks.

    Args:
      spec: the task parameter's modalities.
      params: the parameters of `Generator(spec)`.
    """
    norms = [params[name][OUTPUT_NORM] for name, modality in spec.items() if isinstance(modality, Vector)]
    return sum((_divergence(norm["bias"], norm["scale"]) for norm in norms), jnp.float32(0.0))


def _divergence(mean: Float[Array, "n"], deviation: Float[Array, "n"]) -> Float[Array, ""]:
    variance = deviation**2 + 1e-8
    return 0.5 * jnp.sum(mean**2 + variance - jnp.log(variance) - 1.0)


def stream(
    hidden: Float[Array, "batch hidden"], height: int, width: int, *, norm: partial[nn.BatchNorm]
) -> Float[Array, "batch h w channels"]:
    """Two transposed convolutions from a quarter of a board, inside the module that calls it.

    Boards whose sides are no multiple of four are cut out of the next larger one.
    """
    shape = (-(-height // 4), -(-width // 4), CHANNELS)
    x = nn.relu(norm()(Dense(prod(shape), use_bias=False)(hidden))).reshape(-1, *shape)
    for _ in range(2):
        x = nn.relu(norm()(ConvTranspose(CHANNELS)(x)))
    return x[:, :height, :width]


class GridHead(nn.Module):
    """A `stream`, a convolution, a softmax: [batch, hidden] -> [batch, h, w, c].

    The scores are normalised cell by cell, over the batch alone: over cells too, one board could have all the variance
    within it and be the same for every z.
    """

    grid: Grid
    blank_bias: float
    norm: partial[nn.BatchNorm]

    @nn.compact
    def __call__(self, hidden: Float[Array, "batch hidden"]) -> Float[Array, "batch h w c"]:
        x = stream(hidden, self.grid.height, self.grid.width, norm=self.norm)
        x = self.norm(axis=(-3, -2, -1), bias_init=self._blank)(Conv(self.grid.categories, use_bias=False)(x))
        return nn.softmax(x)

    def _blank(self, key: Key[Array, ""], shape: Sequence[int], dtype: Any = jnp.float32) -> Float[Array, "h w c"]:
        del key
        return jnp.zeros(shape, dtype).at[..., 0].set(self.blank_bias)


class TableHead(nn.Module):
    """A `stream` over rows by categories, a convolution to one score each, a softmax: [batch, hidden] -> [batch, rows,
    categories].

    The paper makes "grid and table" in the same way.  Scores are normalised one by one, as a grid's are cell by cell.
    """

    table: Table
    norm: partial[nn.BatchNorm]

    @nn.compact
    def __call__(self, hidden: Float[Array, "batch hidden"]) -> Float[Array, "batch rows categories"]:
        x = stream(hidden, self.table.rows, self.table.categories, norm=self.norm)
        scores = Conv(1, use_bias=False)(x).squeeze(-1)
        return nn.softmax(self.norm(axis=(-2, -1))(scores))
