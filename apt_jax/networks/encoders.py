"""Encoders of observations and task parameters, built from their spec (paper, appendix "Network Architectures")."""

from __future__ import annotations

from typing import TypeAlias

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from apt_jax.networks.layers import Conv, Dense
from apt_jax.specs import Grid, Modality, Obs, Params, Spec, Table, Vector

ENCODING_SIZE = 64
CHANNELS = 16
MERGE_SIZE = 128

Features: TypeAlias = dict[str, Float[Array, "..."]]
"""Per modality: a Vector's numbers in [-1, 1], shape [..., size]; a Grid's channels, shape [..., h, w, categories]; a
Table's rows side by side, shape [..., rows * categories]."""


def observation_features(spec: Spec, obs: Obs) -> Features:
    """What the networks see of an observation: vectors over their scale, grids and tables one-hot."""
    features = {}
    for name, modality in spec.items():
        match modality:
            case Vector():
                features[name] = obs[name].astype(jnp.float32) / modality.scale
            case Grid():
                features[name] = jax.nn.one_hot(obs[name], modality.categories)
            case Table():
                features[name] = _flat(jax.nn.one_hot(obs[name], modality.categories))
    return features


def parameter_features(spec: Spec, w: Params) -> Features:
    """What the networks see of a task parameter: vectors over their scale, scores as they are."""

    def feature(modality: Modality, block: Array) -> Array:
        match modality:
            case Vector():
                return block / modality.scale
            case Grid():
                return block
            case Table():
                return _flat(block)

    return {name: feature(modality, w[name]) for name, modality in spec.items()}


def _flat(rows: Float[Array, "*batch rows categories"]) -> Float[Array, "*batch flat"]:
    """Rows side by side: their order carries no distance that a convolution could use."""
    return rows.reshape(*rows.shape[:-2], -1)


class GridStack(nn.Module):
    """Two convolutions of stride 2, flattened: [..., h, w, c] -> [..., ceil(h/4) * ceil(w/4) * 16]."""

    @nn.compact
    def __call__(self, x: Float[Array, "*batch h w c"]) -> Float[Array, "*batch flat"]:
        for _ in range(2):
            x = nn.relu(Conv(CHANNELS, stride=2)(x))
        return x.reshape(*x.shape[:-3], -1)


class Encoder(nn.Module):
    """One 64-dimensional encoding per modality, side by side: features -> [..., 64 * len(spec)]."""

    spec: Spec

    @nn.compact
    def __call__(self, features: Features) -> Float[Array, "*batch encoding"]:
        encodings = []
        for name, modality in self.spec.items():
            x = GridStack(name=f"{name}_stack")(features[name]) if isinstance(modality, Grid) else features[name]
            encodings.append(nn.relu(Dense(ENCODING_SIZE, name=name)(x)))
        return jnp.concatenate(encodings, axis=-1)


class Head(nn.Module):
    """Merges encodings by a 128-dimensional layer and predicts: [..., encoding] -> [..., outputs]."""

    outputs: int

    @nn.compact
    def __call__(self, encoding: Float[Array, "*batch encoding"]) -> Float[Array, "*batch outputs"]:
        hidden = nn.relu(Dense(MERGE_SIZE, name="merge")(encoding))
        return Dense(self.outputs, name="output")(hidden)
