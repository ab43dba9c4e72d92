"""Saving a pytree of arrays and restoring it, bit for bit: a thin layer on orbax.

Typed PRNG keys and sharded arrays are stored as they are.  Processes that share an array each write and read a part of it, so
they save and restore together.  A step is written beside the previous one and takes its place only when complete, so an
interrupted save loses nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import jax
import orbax.checkpoint as ocp

Tree = TypeVar("Tree")


class CheckpointError(Exception):
    """A checkpoint is missing, damaged, of another shape than asked for, or in the way of one to be saved."""


def save(directory: Path, step: int, tree: Any) -> None:
    """Writes `tree` as the checkpoint of `step` and drops older ones; returns once it is on disk.

    Raises:
      CheckpointError: the directory has a checkpoint of that step or a later one.
    """
    with _manager(directory) as manager:
        if not manager.save(step, args=ocp.args.StandardSave(tree)):
            raise CheckpointError(f"{directory} has a checkpoint of step {latest_step(directory)}, got step {step} to save")


def restore(directory: Path, template: Tree) -> Tree:
    """The latest checkpoint.

    Args:
      directory: where `save` wrote.
      template: arrays, or `ShapeDtypeStruct`s with a sharding: structure, shapes, dtypes and placement of the result.

    Raises:
      CheckpointError: there is none, or it cannot be read as that.
    """
    step = _require_step(directory)
    abstract = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), template)
    with _readable(directory, step), _manager(directory) as manager:
        return manager.restore(step, args=ocp.args.StandardRestore(abstract))


def rows(directory: Path) -> int:
    """The leading axis that all arrays of the latest checkpoint share, scalars aside.

    Raises:
      CheckpointError: there is no checkpoint, or it cannot be read.
    """
    step = _require_step(directory)
    with _readable(directory, step):
        saved = ocp.StandardCheckpointHandler().metadata(directory.resolve() / str(step) / "default")
        (length,) = {leaf.shape[0] for leaf in jax.tree.leaves(saved.tree) if leaf.shape}
        return length


def latest_step(directory: Path) -> int | None:
    """The step of the latest complete checkpoint, None without one; any process may ask by itself."""
    latest = ocp.path.step.latest_step_metadata(directory.resolve(), ocp.path.step.standard_name_format())
    return latest and latest.step


def _require_step(directory: Path) -> int:
    step = latest_step(directory)
    if step is None:
        raise CheckpointError(f"no checkpoint in {directory}")
    return step


@contextmanager
def _readable(directory: Path, step: int) -> Iterator[None]:
    """Whatever goes wrong within it is a `CheckpointError`."""
    try:
        yield
    except Exception as error:  # orbax and its storage layer raise many unrelated types
        raise CheckpointError(f"checkpoint {step} in {directory} cannot be restored: {error}") from error


def _manager(directory: Path) -> ocp.CheckpointManager:
    options = ocp.CheckpointManagerOptions(max_to_keep=1, enable_async_checkpointing=False)
    return ocp.CheckpointManager(directory.resolve(), options=options)
