"""Named modalities of observations and task parameters.

A *spec* is a mapping from a modality's name to its `Vector`, `Grid` or `Table`.  Observations and task parameters `w` are
dicts of arrays with the same names.  Networks are built from specs alone, so a new task space needs no network code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array


@dataclass(frozen=True)
class Vector:
    """`size` numbers in [`low`, `high`], stored as `dtype` of shape [size].

    Networks see them divided by `scale`, so that zero stays zero.
    """

    size: int
    low: float
    high: float
    dtype: str = "float32"

    def __post_init__(self) -> None:
        if self.size < 1 or not self.low < self.high:
            raise ValueError(f"Vector needs size >= 1 and low < high, got {self}")

    @property
    def scale(self) -> float:
        """The largest magnitude a number can have."""
        return max(abs(self.low), abs(self.high))


@dataclass(frozen=True)
class Grid:
    """A `height` x `width` board of `categories`.

    As an observation: uint8 category indices [height, width].  As a task parameter: float32 scores
    [height, width, categories] of which the task space takes the argmax.  Category 0 is that of a cell with nothing in it.
    """

    height: int
    width: int
    categories: int

    def __post_init__(self) -> None:
        if min(self.height, self.width) < 1 or self.categories < 2:
            raise ValueError(f"Grid needs height, width >= 1 and categories >= 2, got {self}")


@dataclass(frozen=True)
class Table:
    """`rows` independent choices among `categories` that lie on no board, such as the place of each of several objects.

    As an observation: uint8 indices [rows].  As a task parameter: float32 scores [rows, categories] of which the task space
    takes the argmax.  No category stands out.
    """

    rows: int
    categories: int

    def __post_init__(self) -> None:
        if self.rows < 1 or self.categories < 2:
            raise ValueError(f"Table needs rows >= 1 and categories >= 2, got {self}")


Modality: TypeAlias = Vector | Grid | Table
Spec: TypeAlias = Mapping[str, Modality]
Obs: TypeAlias = dict[str, Array]
Params: TypeAlias = dict[str, Array]


def obs_struct(spec: Spec) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes and dtypes of one stored observation."""

    def struct(modality: Modality) -> jax.ShapeDtypeStruct:
        match modality:
            case Vector():
                return jax.ShapeDtypeStruct((modality.size,), jnp.dtype(modality.dtype))
            case Grid():
                return jax.ShapeDtypeStruct((modality.height, modality.width), jnp.uint8)
            case Table():
                return jax.ShapeDtypeStruct((modality.rows,), jnp.uint8)

    return {name: struct(modality) for name, modality in spec.items()}


def param_struct(spec: Spec) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes and dtypes of one task parameter `w`."""

    def struct(modality: Modality) -> jax.ShapeDtypeStruct:
        match modality:
            case Vector():
                return jax.ShapeDtypeStruct((modality.size,), jnp.float32)
            case Grid():
                return jax.ShapeDtypeStruct((modality.height, modality.width, modality.categories), jnp.float32)
            case Table():
                return jax.ShapeDtypeStruct((modality.rows, modality.categories), jnp.float32)

    return {name: struct(modality) for name, modality in spec.items()}


def zeros_like(struct: Any, leading: tuple[int, ...] = ()) -> Any:
    """Zeros for every `ShapeDtypeStruct` of a pytree, with `leading` axes put before each shape."""
    return jax.tree.map(lambda s: jnp.zeros(leading + s.shape, s.dtype), struct)
