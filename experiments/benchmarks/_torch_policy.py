"""The policy of the PyTorch fixture: Double DQN as in `apt_jax.learner`."""

from __future__ import annotations

import copy

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from apt_jax.config import HParams
from experiments.benchmarks._torch_networks import QNetwork, Tensors
from experiments.benchmarks._torch_replay import Batch


class Policy:
    """The online Q-network, its Polyak average and Adam.

    Args:
      compiled: compile what an update computes, forward and backward, by `torch.compile`.
    """

    def __init__(self, hparams: HParams, *, compiled: bool = False) -> None:
        self.hparams = hparams
        self.online = QNetwork()
        self.average = copy.deepcopy(self.online).requires_grad_(False)
        self.optimizer = torch.optim.Adam(self.online.parameters(), lr=hparams.learning_rate)
        self._loss = torch.compile(self.loss) if compiled else self.loss
        self._descend = torch.compile(self.descend) if compiled else self.descend

    def act(self, obs: Tensors) -> Int[Tensor, "B"]:
        """Greedy actions."""
        with torch.no_grad():
            return self.online(obs).argmax(dim=-1)

    def loss(self, batch: Batch, low: Float[Tensor, ""], high: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Mean Huber loss; the average network's value of the online network's choice is clipped to [`low`, `high`]."""
        with torch.no_grad():
            choice = self.online(batch.next_obs).argmax(dim=-1, keepdim=True)
            bootstrap = self.average(batch.next_obs).gather(1, choice).squeeze(1)
            target = batch.reward + batch.discount * bootstrap.clamp(low, high)
        q = self.online(batch.obs).gather(1, batch.action[:, None]).squeeze(1)
        return F.huber_loss(q, target)

    def descend(self) -> None:
        """A step of Adam, and the average a step nearer."""
        self.optimizer.step()
        with torch.no_grad():
            for average, online in zip(self.average.parameters(), self.online.parameters(), strict=True):
                average.lerp_(online, self.hparams.target_rate)

    def update(self, batch: Batch, low: float, high: float) -> None:
        """One update."""
        loss = self._loss(batch, torch.tensor(low), torch.tensor(high))
        self.optimizer.zero_grad()
        loss.backward()
        self._descend()
