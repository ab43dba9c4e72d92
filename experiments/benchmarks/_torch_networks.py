"""APT-Gen's networks as plain PyTorch modules, layer for layer those of `apt_jax.networks` for Grid-World's specs.

Images lie in memory as they do elsewhere in PyTorch (channels first) and weights start as PyTorch starts them.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.utils import parametrize

from apt_jax.networks.encoders import CHANNELS, ENCODING_SIZE, MERGE_SIZE
from apt_jax.networks.layers import KERNEL_SIZE, same_padding
from apt_jax.specs import Grid, Spec, Vector
from envs.grid_world.board import BOARD, CATEGORIES, INTERIOR, OBJECTS
from envs.grid_world.dynamics import MOVES
from envs.grid_world.observation import OBS_SPEC
from envs.grid_world.placement import PARAM_SPEC

ACTIONS = len(MOVES)
COORDINATES = 2 * OBJECTS
QUARTER = INTERIOR // 4
"""Rows and columns that the generator's transposed convolutions begin with."""

Tensors: TypeAlias = dict[str, Tensor]
"""An observation or a task parameter, by modality, with any leading axes."""


def observation_features(obs: Tensors) -> Tensors:
    """Vectors over their scale, [B, size]; the view one-hot, [B, categories, h, w]."""

    def feature(name: str, block: Tensor) -> Tensor:
        modality = OBS_SPEC[name]
        if isinstance(modality, Vector):
            return block.float() / modality.scale
        return F.one_hot(block.long(), CATEGORIES).movedim(-1, 1).float()

    return {name: feature(name, block) for name, block in obs.items()}


def parameter_features(w: Tensors) -> Tensors:
    """Coordinates over their scale, [B, 10]; scores as they are, [B, categories, h, w]."""
    return {"tiles": w["tiles"].movedim(-1, 1), "xy": w["xy"] / BOARD}


class GridEncoder(nn.Module):
    """Two 3 x 3 convolutions of stride 2, padded as 'SAME' is in XLA, and a linear layer: [B, c, h, w] -> [B, 64]."""

    def __init__(self, grid: Grid) -> None:
        super().__init__()
        sizes, layers, channels = (grid.height, grid.width), [], grid.categories
        for _ in range(2):
            (rows, above, below), (columns, left, right) = (same_padding(size, 2) for size in sizes)
            # A convolution pads both ends alike; where XLA pads the far end more, the rest comes before it.
            if (below, right) != (above, left):
                layers.append(nn.ZeroPad2d((0, right - left, 0, below - above)))
            layers += [nn.Conv2d(channels, CHANNELS, KERNEL_SIZE, stride=2, padding=(above, left)), nn.ReLU()]
            sizes, channels = (rows, columns), CHANNELS
        self.convolutions = nn.Sequential(*layers)
        self.linear = nn.Linear(CHANNELS * math.prod(sizes), ENCODING_SIZE)

    def forward(self, x: Float[Tensor, "B c h w"]) -> Float[Tensor, "B 64"]:
        return self.linear(self.convolutions(x).flatten(1))


class Encoder(nn.Module):
    """An encoding of each modality, side by side: features -> [B, 64 * modalities]."""

    def __init__(self, spec: Spec) -> None:
        super().__init__()
        self.encodings = nn.ModuleDict()
        for name, modality in spec.items():
            match modality:
                case Vector():
                    self.encodings[name] = nn.Linear(modality.size, ENCODING_SIZE)
                case Grid():
                    self.encodings[name] = GridEncoder(modality)

    def forward(self, features: Tensors) -> Float[Tensor, "B encoding"]:
        return torch.cat([F.relu(encoding(features[name])) for name, encoding in self.encodings.items()], dim=-1)


class Head(nn.Sequential):
    """[B, inputs] -> [B, outputs] by way of 128."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(nn.Linear(inputs, MERGE_SIZE), nn.ReLU(), nn.Linear(MERGE_SIZE, outputs))


class QNetwork(nn.Module):
    """Observations -> a value for each action, [B, 4]."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder(OBS_SPEC)
        self.head = Head(ENCODING_SIZE * len(OBS_SPEC), ACTIONS)

    def forward(self, obs: Tensors) -> Float[Tensor, "B 4"]:
        return self.head(self.encoder(observation_features(obs)))


class ValueNetwork(nn.Module):
    """Task parameters -> a number each, [B]."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder(PARAM_SPEC)
        self.head = Head(ENCODING_SIZE * len(PARAM_SPEC), 1)

    def forward(self, w: Tensors) -> Float[Tensor, "B"]:
        return self.head(self.encoder(parameter_features(w))).squeeze(-1)


class Discriminator(nn.Module):
    """A logit of each rollout's initial observation, [B], and of K of its steps, [B, K].

    Args:
      spectral_bound: largest spectral norm that a layer's weight is used with.
    """

    def __init__(self, spectral_bound: float) -> None:
        super().__init__()
        self.init_encoder = Encoder(OBS_SPEC)
        self.init_head = Head(ENCODING_SIZE * len(OBS_SPEC), 1)
        self.state_encoder = Encoder(OBS_SPEC)
        self.action_encoder = nn.Linear(ACTIONS, ENCODING_SIZE)
        self.reward_encoder = nn.Linear(1, ENCODING_SIZE)
        self.step_head = Head(ENCODING_SIZE * (2 * len(OBS_SPEC) + 2), 1)
        if math.isfinite(spectral_bound):
            for layer in list(self.modules()):
                if isinstance(layer, nn.Linear | nn.Conv2d):
                    parametrize.register_parametrization(layer, "weight", SpectralBound(layer.weight, spectral_bound))

    def forward(
        self,
        initial_obs: Tensors,
        obs: Tensors,
        action: Int[Tensor, "B K"],
        *,
        reward: Float[Tensor, "B K"],
        next_obs: Tensors,
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B K"]]:
        initial = self.init_head(self.init_encoder(observation_features(initial_obs))).squeeze(-1)
        both = {name: torch.cat([obs[name], next_obs[name]]).flatten(0, 1) for name in obs}
        state, next_state = self.state_encoder(observation_features(both)).chunk(2)
        action_encoding = F.relu(self.action_encoder(F.one_hot(action.flatten(), ACTIONS).float()))
        reward_encoding = F.relu(self.reward_encoder(reward.reshape(-1, 1)))
        steps = self.step_head(torch.cat([state, action_encoding, reward_encoding, next_state], dim=-1))
        return initial, steps.view_as(reward)


class SpectralBound(nn.Module):
    """Scales a weight whose spectral norm is above `bound` down to it, by one power iteration a use (SN-GAN)."""

    right: Tensor

    def __init__(self, weight: Tensor, bound: float) -> None:
        super().__init__()
        self.bound = bound
        self.register_buffer("right", F.normalize(torch.randn(weight[0].numel()), dim=0))

    def forward(self, weight: Tensor) -> Tensor:
        matrix = weight.flatten(1)
        with torch.no_grad():
            left = F.normalize(matrix @ self.right, dim=0)
            right = F.normalize(left @ matrix, dim=0)
            self.right.copy_(right)
        return weight / (left @ matrix @ right / self.bound).clamp(min=1)


class Generator(nn.Module):
    """Noise [B, noise] -> task parameters, with batch normalisation after every layer.

    PyTorch's running variances are those of samples, n / (n - 1) times ours.

    Args:
      blank_bias: initial bias of the scores of an empty tile.
    """

    def __init__(self, noise_size: int, blank_bias: float) -> None:
        super().__init__()
        self.noise = nn.Sequential(nn.Linear(noise_size, ENCODING_SIZE, bias=False), nn.BatchNorm1d(ENCODING_SIZE), nn.ReLU())
        self.xy = nn.Sequential(nn.Linear(ENCODING_SIZE, COORDINATES, bias=False), nn.BatchNorm1d(COORDINATES))
        start = CHANNELS * QUARTER**2
        self.board = nn.Sequential(nn.Linear(ENCODING_SIZE, start, bias=False), nn.BatchNorm1d(start), nn.ReLU())
        self.upsample = nn.Sequential(Upsample(), Upsample())
        self.scores = nn.Conv2d(CHANNELS, CATEGORIES, KERNEL_SIZE, padding=1, bias=False)
        self.scores_norm = nn.BatchNorm1d(INTERIOR**2 * CATEGORIES)
        with torch.no_grad():
            self.scores_norm.bias.view(-1, CATEGORIES)[:, 0] = blank_bias

    def forward(self, z: Float[Tensor, "B noise"]) -> Tensors:
        hidden = self.noise(z)
        board = self.board(hidden).view(-1, CHANNELS, QUARTER, QUARTER)
        scores = self.scores(self.upsample(board)).movedim(1, -1)
        tiles = self.scores_norm(scores.flatten(1)).view_as(scores).softmax(dim=-1)
        return {"tiles": tiles, "xy": BOARD * self.xy(hidden).sigmoid()}

    def coordinate_divergence(self) -> Float[Tensor, ""]:
        """KL(N(bias, scale^2) || N(0, 1)) of the coordinates before their sigmoid, summed."""
        variance = self.xy[1].weight ** 2 + 1e-8
        return 0.5 * (self.xy[1].bias ** 2 + variance - variance.log() - 1).sum()


class Upsample(nn.Module):
    """A 3 x 3 transposed convolution of stride 2, cut off as 'SAME' is in XLA: [B, 16, h, w] -> [B, 16, 2h, 2w]."""

    def __init__(self) -> None:
        super().__init__()
        self.convolution = nn.ConvTranspose2d(CHANNELS, CHANNELS, KERNEL_SIZE, stride=2, bias=False)
        self.norm = nn.BatchNorm2d(CHANNELS)

    def forward(self, x: Float[Tensor, "B c h w"]) -> Float[Tensor, "B c 2*h 2*w"]:
        return F.relu(self.norm(self.convolution(x)[..., :-1, :-1]))
