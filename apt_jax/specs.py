"""Named modalities of observations and task parameters.

A *spec* is a mapping from a modality's name to its `Vector`, `Grid` or `Table`.  Observations and task parameters `w` are
dicts of arrays with the same names.  Networks are built from specs alone, so a new task space needs no network code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


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
        if self.size < 1 or not -math.inf < self.low < self.high < math.inf:
            raise ValueError(f"Vector needs size >= 1 and finite low < high, got {self}")
        if self.dtype != "float32":
            if not np.issubdtype(self.dtype, np.integer):
                raise ValueError(f"Vector stores float32 or whole numbers, got {self}")
            held = np.iinfo(self.dtype)
            if held.bits > 32:
                raise ValueError(f"Vector stores at most 32 bits, as JAX does, got {self}")
            if not held.min <= self.low < self.high <= held.max:
                raise ValueError(f"Vector needs a dtype that holds low and high, {held.min} to {held.max}, got {self}")

    @property
    def scale(self) -> float:
        """The largest magnitude a number can have."""
        return max(abs(self.low), abs(self.high))

    @property
    def observation(self) -> jax.ShapeDtypeStruct:
        """What is stored of an observation."""
        return jax.ShapeDtypeStruct((self.size,), jnp.dtype(self.dtype))

    @property
    def parameter(self) -> jax.ShapeDtypeStruct:
        """A block of a task parameter."""
        return jax.ShapeDtypeStruct((self.size,), jnp.float32)


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

    @property
    def observation(self) -> jax.ShapeDtypeStruct:
        """What is stored of an observation."""
        return jax.ShapeDtypeStruct((self.height, self.width), jnp.uint8)

    @property
    def parameter(self) -> jax.ShapeDtypeStruct:
        """A block of a task parameter."""
        return jax.ShapeDtypeStruct((self.height, self.width, self.categories), jnp.float32)


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

    @property
    def observation(self) -> jax.ShapeDtypeStruct:
        """What is stored of an observation."""
        return jax.ShapeDtypeStruct((self.rows,), jnp.uint8)

    @property
    def parameter(self) -> jax.ShapeDtypeStruct:
        """A block of a task parameter."""
        return jax.ShapeDtypeStruct((self.rows, self.categories), jnp.float32)


Modality: TypeAlias = Vector | Grid | Table
Spec: TypeAlias = Mapping[str, Modality]
Obs: TypeAlias = dict[str, Array]
Params: TypeAlias = dict[str, Array]


def obs_struct(spec: Spec) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes and dtypes of one stored observation."""
    return {name: modality.observation for name, modality in spec.items()}


def param_struct(spec: Spec) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes and dtypes of one task parameter `w`."""
    return {name: modality.parameter for name, modality in spec.items()}


def flatten(spec: Spec, w: Params) -> Float[Array, "*batch D"]:
    """A task parameter as one vector, block after block: vectors as shares of their range, so in [0, 1], scores as they are."""

    def block(name: str, modality: Modality) -> Array:
        match modality:
            case Vector():
                return (w[name] - modality.low) / (modality.high - modality.low)
            case Grid():
                return w[name].reshape(*w[name].shape[:-3], -1)
            case Table():
                return w[name].reshape(*w[name].shape[:-2], -1)

    return jnp.concatenate([block(name, modality) for name, modality in spec.items()], axis=-1)


def unflatten(spec: Spec, vector: Float[Array, "*batch D"]) -> Params:
    """The task parameter of any vector, brought into range without a change of its categories.

    Vectors are clipped.  Scores clipped one by one would tie above 1, and a tie goes to the first category; so the scores of a
    choice that leave [0, 1] are moved and shrunk together, which keeps their order.
    """
    struct = param_struct(spec)
    ends = np.cumsum([block.size for block in struct.values()])
    w = {}
    for (name, modality), block in zip(spec.items(), jnp.split(vector, ends[:-1], axis=-1), strict=True):
        match modality:
            case Vector():
                w[name] = modality.low + (modality.high - modality.low) * jnp.clip(block, 0.0, 1.0)
            case Grid() | Table():
                scores = block.reshape(*block.shape[:-1], *struct[name].shape)
                scores = scores - jnp.minimum(jnp.min(scores, axis=-1, keepdims=True), 0.0)
                w[name] = scores / jnp.maximum(jnp.max(scores, axis=-1, keepdims=True), 1.0)
    return w


def block_weights(spec: Spec) -> Float[np.ndarray, "D"]:
    """Factors on flattened parameters by which every block, however many numbers it has, weighs the same in a distance."""
    sizes = [struct.size for struct in param_struct(spec).values()]
    return np.concatenate([np.full(size, size**-0.5, np.float32) for size in sizes])


def zeros_like(struct: Any, leading: tuple[int, ...] = ()) -> Any:
    """Zeros for every `ShapeDtypeStruct` of a pytree, with `leading` axes put before each shape."""
    return jax.tree.map(lambda s: jnp.zeros(leading + s.shape, s.dtype), struct)
