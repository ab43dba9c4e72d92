"""The lanes of an experiment: every seed with every combination of swept hyper-parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from apt_jax.config import HParams


@dataclass(frozen=True)
class Lane:
    """One lane of the compiled program.

    Attributes:
      seed: of everything random.
      setting: the hyper-parameters that differ between lanes, by name.
      hparams: all of them.
    """

    seed: int
    setting: Mapping[str, float]
    hparams: HParams

    @property
    def index(self) -> dict[str, float]:
        """The columns by which this lane's rows are told from those of others."""
        return {"seed": self.seed, **self.setting}

    @property
    def name(self) -> str:
        """For example "seed 3" or "seed 3, delta 0.1"."""
        return ", ".join(f"{name} {value:.10g}" for name, value in self.index.items())  # ten digits: those of the largest seed

    @property
    def slug(self) -> str:
        """The name as a part of a file's name."""
        return self.name.replace(", ", "_").replace(" ", "_")


def swept(hparams: HParams) -> dict[str, tuple[float, ...]]:
    """The fields that hold several values."""
    fields = {field.name: getattr(hparams, field.name) for field in dataclasses.fields(hparams)}
    return {name: value for name, value in fields.items() if isinstance(value, tuple)}


def expand(seeds: Sequence[int], hparams: HParams) -> tuple[Lane, ...]:
    """All combinations, the seeds of one setting side by side; a field of `hparams` may hold a tuple of values."""
    sweep = swept(hparams)
    settings = [dict(zip(sweep, values, strict=True)) for values in product(*sweep.values())]
    return tuple(Lane(seed, setting, dataclasses.replace(hparams, **setting)) for setting in settings for seed in seeds)


def values_type() -> Any:
    """A dataclass with the fields and the help of `HParams`, each holding one or more values: what the command line reads."""
    fields: list[Any] = [
        (field.name, tuple[float, ...], dataclasses.field(default=(field.default,))) for field in dataclasses.fields(HParams)
    ]
    values = dataclasses.make_dataclass("HParams", fields, frozen=True)
    values.__doc__ = HParams.__doc__
    return values


def to_values(hparams: HParams) -> dict[str, tuple[float, ...]]:
    """Every field as a tuple."""
    sweep = swept(hparams)
    return {field.name: sweep.get(field.name, (getattr(hparams, field.name),)) for field in dataclasses.fields(hparams)}


def from_values(values: Mapping[str, Sequence[float]]) -> HParams:
    """The inverse of `to_values`."""
    fields: dict[str, Any] = {name: tuple(several) if len(several) != 1 else several[0] for name, several in values.items()}
    return HParams(**fields)
