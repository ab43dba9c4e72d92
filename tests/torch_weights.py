"""Which weight of the PyTorch fixture is which of ours.

Every function yields pairs of a module's parameter and the same numbers of a flax tree in the parameter's layout.  The tree may
hold parameters or gradients.
"""

from __future__ import annotations

import jax
import numpy as np
import torch
from flax.traverse_util import unflatten_dict
from torch import nn
from torch.nn.utils import parametrize

CHANNELS = 16


def load(module, pairs):
    """Gives all parameters of a module the numbers that are paired with them."""
    pairs = list(pairs)
    assert {parameter for parameter, _ in pairs} == set(module.parameters())
    copy(pairs)


def copy(pairs):
    with torch.no_grad():
        for parameter, value in pairs:
            assert parameter.shape == value.shape
            parameter.copy_(torch.from_numpy(np.array(value)))


def q_network(module, variables):
    yield from encoder(module.encoder, variables["params"]["encoder"])
    yield from head(module.head, variables["params"]["head"])


def ensemble(modules, variables):
    """Of value networks, leaves [K, ...]."""
    for k, module in enumerate(modules):
        yield from q_network(module, jax.tree.map(lambda x, k=k: x[k], variables))


def discriminator(module, variables):
    params = variables["params"]
    for branch in ("init", "state"):
        yield from encoder(getattr(module, f"{branch}_encoder"), params[f"{branch}_encoder"])
    for branch in ("init", "step"):
        yield from head(getattr(module, f"{branch}_head"), params[f"{branch}_head"])
    yield from dense(module.action_encoder, params["action_encoder"])
    yield from dense(module.reward_encoder, params["reward_encoder"])


def singular_vectors(module, vectors):
    """The power iteration's vectors in place of the parameters: each is laid out as a column of its kernel is."""
    rights = {weight(layer): layer.parametrizations.weight[0].right for layer in module.modules() if is_bound(layer)}
    columns = unflatten_dict({path: vector[:, None] for path, vector in vectors.items()}, sep="/")
    for parameter, column in discriminator(module, columns):
        yield rights[parameter], column.reshape(-1)


def generator(module, params):
    tiles = params["tiles"]
    yield from dense(module.noise[0], params["noise"])
    yield from dense(module.xy[0], params["xy"]["Dense_0"])
    yield from dense(module.board[0], {"kernel": jax.vmap(channels_first)(tiles["Dense_0"]["kernel"])})
    for i, upsample in enumerate(module.upsample):
        # Ours counts taps from the far end.
        kernel = tiles[f"ConvTranspose_{i}"]["kernel"].reshape(CHANNELS, 3, 3, CHANNELS)
        yield upsample.convolution.weight, kernel[:, ::-1, ::-1].transpose(0, 3, 1, 2)
    yield from conv(module.scores, tiles["Conv_0"])
    for layer, norm in norms(module, params):
        yield layer.weight, norm["scale"]
        yield layer.bias, norm["bias"]


def statistics(module, stats):
    """The generator's running statistics in place of parameters."""
    for layer, norm in norms(module, stats):
        yield layer.running_mean, norm["mean"]
        yield layer.running_var, norm["var"]


def norms(module, tree):
    """The generator's normalisations, each with what a tree holds of it."""
    tiles = tree["tiles"]
    yield module.noise[1], tree["noise_norm"]
    yield module.xy[1], tree["xy"]["output_norm"]
    yield module.board[1], jax.tree.map(channels_first, tiles["BatchNorm_0"])
    for i, upsample in enumerate(module.upsample):
        yield upsample.norm, tiles[f"BatchNorm_{i + 1}"]
    yield module.scores_norm, jax.tree.map(np.ravel, tiles["BatchNorm_3"])


def encoder(module, params):
    for name, encoding in module.encodings.items():
        if isinstance(encoding, nn.Linear):
            yield from dense(encoding, params[name])
        else:
            layers = [layer for layer in encoding.convolutions if isinstance(layer, nn.Conv2d)]
            for i, layer in enumerate(layers):
                yield from conv(layer, params[f"{name}_stack"][f"Conv_{i}"])
            yield from dense(encoding.linear, {**params[name], "kernel": channels_first(params[name]["kernel"])})


def head(module, params):
    yield from dense(module[0], params["merge"])
    yield from dense(module[2], params["output"])


def dense(layer, params):
    yield weight(layer), params["kernel"].T
    if "bias" in params:
        yield layer.bias, params["bias"]


def conv(layer, params):
    kernel = params["kernel"].reshape(3, 3, layer.in_channels, -1)
    yield weight(layer), kernel.transpose(3, 2, 0, 1)
    if "bias" in params:
        yield layer.bias, params["bias"]


def channels_first(x):
    """The first axis of an array, pixels by channels, turned to channels by pixels."""
    return x.reshape(-1, CHANNELS, *x.shape[1:]).swapaxes(0, 1).reshape(x.shape)


def weight(layer):
    """The parameter that is trained, also where the layer is used with a function of it."""
    return layer.parametrizations.weight.original if is_bound(layer) else layer.weight


def is_bound(layer):
    return parametrize.is_parametrized(layer)
