"""The curriculum of the PyTorch fixture: discriminator, both values and generator as in `apt_jax.curricula.apt_gen`."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from apt_jax.config import Config, HParams
from envs.grid_world.board import CATEGORIES
from experiments.benchmarks._torch_networks import Discriminator, Generator, Tensors, ValueNetwork
from experiments.benchmarks._torch_replay import Rollouts

SETTLING_BATCHES = 100


class Models:
    """All that one Adam trains, each on its own loss and on the others as they were before the update.

    The values' weights decay before Adam's step instead of after it, a difference of learning rate times decay in the step.

    Args:
      compiled: compile what an update computes, forward and backward, by `torch.compile`.
    """

    def __init__(self, config: Config, hparams: HParams, *, compiled: bool = False) -> None:
        self.config, self.hparams = config, hparams
        self.generator = Generator(config.noise_size, config.blank_bias)
        self.discriminator = Discriminator(hparams.spectral_bound)
        self.progress_value = nn.ModuleList(ValueNetwork() for _ in range(config.value_ensemble))
        self.return_value = nn.ModuleList(ValueNetwork() for _ in range(config.value_ensemble))
        self.values = nn.ModuleList([self.progress_value, self.return_value])
        groups = [
            {"params": self.generator.parameters(), "lr": hparams.generator_learning_rate, "weight_decay": 0.0},
            {"params": self.discriminator.parameters(), "lr": hparams.discriminator_learning_rate, "weight_decay": 0.0},
            {
                "params": self.values.parameters(),
                "lr": hparams.value_learning_rate,
                "weight_decay": hparams.value_weight_decay,
            },
        ]
        self.optimizer = torch.optim.AdamW(groups)
        # The first tasks are drawn from running statistics, which must describe the fresh generator before it is used.
        with torch.no_grad():
            for _ in range(SETTLING_BATCHES):
                self.generator(self.noise(config.model_batch_size))
        self._discriminator_loss = torch.compile(self.discriminator_loss) if compiled else self.discriminator_loss
        self._value_loss = torch.compile(self.value_loss) if compiled else self.value_loss
        self._generator_loss = torch.compile(self.generator_loss) if compiled else self.generator_loss
        self._descend = torch.compile(self.optimizer.step) if compiled else self.optimizer.step

    def noise(self, n: int) -> Float[Tensor, "n z"]:
        """What the generator makes tasks of."""
        return torch.randn(n, self.config.noise_size)

    def propose(self) -> Tensors:
        """One task parameter, leaves [1, ...], by the running statistics."""
        self.generator.eval()
        with torch.no_grad():
            w: Tensors = self.generator(self.noise(1))
        self.generator.train()
        return w

    def discriminator_loss(self, target: Rollouts, generated: Rollouts) -> tuple[Float[Tensor, ""], Float[Tensor, "B"]]:
        """Cross-entropy of telling both sources apart, and the logits of the generated rollouts."""

        def join(a: Tensors, b: Tensors) -> Tensors:
            return {name: torch.cat([a[name], b[name]]) for name in a}

        initial, steps = self.discriminator(
            join(target.initial_obs, generated.initial_obs),
            join(target.obs, generated.obs),
            torch.cat([target.action, generated.action]),
            reward=torch.cat([target.reward, generated.reward]),
            next_obs=join(target.next_obs, generated.next_obs),
        )
        if self.config.judge_parts:
            loss, logit = 0.5 * (tell_apart(initial) + tell_apart(steps)), pool_probabilities(initial, steps)
        else:
            logit = pool(initial, steps, torch.cat([target.length, generated.length]))
            loss = tell_apart(logit)
        return loss, logit.chunk(2)[1]

    def value_loss(self, w: Tensors, progress: Float[Tensor, "B"], episode_return: Float[Tensor, "B"]) -> Float[Tensor, ""]:
        """Mean squared errors of every network of both ensembles, summed."""
        outcomes = (self.progress_value, progress), (self.return_value, episode_return)
        return torch.stack([((evaluate(ensemble, w) - outcome) ** 2).mean(dim=1).sum() for ensemble, outcome in outcomes]).sum()

    def generator_loss(self, z: Float[Tensor, "n z"], beta: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """-(V1 + beta (V2 - delta)) of the tasks made of `z`, and the weighted divergence of their coordinates."""
        w = self.generator(z)
        progress, outcome = (pessimistic(evaluate(ensemble, w), self.hparams.pessimism) for ensemble in self.values)
        objective = (progress + beta * (outcome - self.hparams.delta)).mean()
        return self.hparams.vector_prior * self.generator.coordinate_divergence() - objective

    def update(self, target: Rollouts, generated: Rollouts, *, beta: float) -> None:
        """One update of everything."""
        discriminator_loss, logit = self._discriminator_loss(target, generated)
        progress = task_progress(logit.detach(), relative=self.config.relative_progress)
        value_loss = self._value_loss(generated.w, progress, generated.episode_return)
        self.values.requires_grad_(False)
        generator_loss = self._generator_loss(self.noise(self.config.model_batch_size), torch.tensor(beta))
        self.values.requires_grad_(True)
        self.optimizer.zero_grad()
        (discriminator_loss + value_loss + generator_loss).backward()
        self._descend()


def tell_apart(logits: Float[Tensor, "2*B *k"]) -> Float[Tensor, ""]:
    """Cross-entropy of what belongs to the target, the first half, and what was generated."""
    target, generated = logits.chunk(2)
    return F.softplus(-target).mean() + F.softplus(generated).mean()


def pool(initial: Float[Tensor, "n"], steps: Float[Tensor, "n K"], length: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """The mean logit of a rollout's initial observation and of all its steps, estimated from K of these."""
    return (initial + length * steps.mean(dim=-1)) / (1 + length)


def pool_probabilities(initial: Float[Tensor, "n"], steps: Float[Tensor, "n K"]) -> Float[Tensor, "n"]:
    """The logit of a mean probability, half of it the initial observation's."""
    return (0.5 * (initial.sigmoid() + steps.sigmoid().mean(dim=-1))).logit(eps=1e-6)


def evaluate(ensemble: nn.ModuleList, w: Tensors) -> Float[Tensor, "K n"]:
    """What each network says of the tasks that are made of w: of the one-hot of its scores, with the gradient of the scores."""
    scores = w["tiles"]
    tiles = F.one_hot(scores.argmax(dim=-1), CATEGORIES)
    seen = {"tiles": scores + (tiles - scores).detach(), "xy": w["xy"]}
    return torch.stack([network(seen) for network in ensemble])


def task_progress(logit: Float[Tensor, "n"], *, relative: bool) -> Float[Tensor, "n"]:
    """The discriminator's probability; if `relative`, of logits centred and scaled to unit spread."""
    if relative:
        logit = (logit - logit.mean()) / (logit.std(correction=0) + 1e-6)
    return logit.sigmoid()


def pessimistic(values: Float[Tensor, "K n"], pessimism: float) -> Float[Tensor, "n"]:
    """Mean of an ensemble less `pessimism` standard deviations."""
    if len(values) == 1:
        return values[0]
    return values.mean(dim=0) - pessimism * (values.var(dim=0, correction=0) + 1e-8).sqrt()
