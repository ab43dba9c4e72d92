"""Other places to log to, none of them required."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from experiments.errors import UsageError
from experiments.lanes import Lane

Metrics = Mapping[str, Float[np.ndarray, "S"]]


class Sink(Protocol):
    """Takes the metrics of every evaluation."""

    def write(self, env_steps: int, metrics: Metrics) -> None:
        """Metrics with one value per lane."""
        ...

    def close(self) -> None:
        """Everything written is safe after this."""
        ...


_GROUP_LENGTH = 128
"""Characters that W&B allows."""


class TensorBoard:
    """Event files in the run directory."""

    def __init__(self, run_dir: Path, start: int, lanes: Sequence[Lane], config: Mapping[str, Any]):
        import tensorboardX

        self._lanes = lanes
        self._writer = tensorboardX.SummaryWriter(str(run_dir / "tensorboard"), purge_step=start + 1)

    def write(self, env_steps: int, metrics: Metrics) -> None:
        """One scalar per metric and lane."""
        for tag, value in _scalars(metrics, self._lanes).items():
            self._writer.add_scalar(tag, value, env_steps)

    def close(self) -> None:
        """Flushes the event file."""
        self._writer.close()


class WeightsAndBiases:
    """One W&B run per session; sessions of one run directory, by its path, are one group."""

    def __init__(self, run_dir: Path, start: int, lanes: Sequence[Lane], config: Mapping[str, Any]):
        import wandb

        self._lanes = lanes
        group = run_dir.resolve().as_posix()[-_GROUP_LENGTH:]
        self._run = wandb.init(project="apt-jax", group=group, dir=run_dir, config=dict(config))

    def write(self, env_steps: int, metrics: Metrics) -> None:
        """One scalar per metric and lane."""
        self._run.log(_scalars(metrics, self._lanes), step=env_steps)

    def close(self) -> None:
        """Waits for the upload."""
        self._run.finish()


SINKS: dict[str, type[TensorBoard] | type[WeightsAndBiases]] = {"tensorboard": TensorBoard, "wandb": WeightsAndBiases}

_MODULES = {"tensorboard": "tensorboardX", "wandb": "wandb"}
"""What each sink imports, by the extra that brings it."""


def check_installed(names: Sequence[str]) -> None:
    """Raises a `UsageError` that names the extra of a missing package."""
    for name in names:
        if importlib.util.find_spec(_MODULES[name]) is None:
            raise UsageError(f"--sinks {name} needs {_MODULES[name]}: pip install -e '.[{name}]'")


def make_sinks(
    names: Sequence[str], run_dir: Path, *, start: int, lanes: Sequence[Lane], config: Mapping[str, Any]
) -> list[Sink]:
    """The sinks of those names, for a run that goes on after `start` environment steps."""
    return [SINKS[name](run_dir, start, lanes, config) for name in names]


def _scalars(metrics: Metrics, lanes: Sequence[Lane]) -> dict[str, float]:
    return {f"{name}/{lane.slug}": float(values[i]) for name, values in metrics.items() for i, lane in enumerate(lanes)}
