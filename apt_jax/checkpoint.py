"""Saving a pytree of arrays and restoring it, bit for bit: a thin layer on orbax.

Typed PRNG keys and sharded arrays are stored as they are.  A step is written beside the previous one and takes its place only
when complete, so an interrupted save loses nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import jax
import orbax.checkpoint as ocp

Tree = TypeVar("Tree")


class CheckpointError(Exception):
    """A checkpoint is missing, damaged, or of another shape than asked for."""


def save(directory: Path, step: int, tree: Any) -> None:
    """Writes `tree` as the checkpoint of `step` and drops older ones; returns once it is on disk."""
    with _manager(directory) as manager:
        manager.save(step, args=ocp.args.StandardSave(tree))


def restore(directory: Path, template: Tree) -> Tree:
    """The latest checkpoint.

    Args:
      directory: where `save` wrote.
      template: arrays, or `ShapeDtypeStruct`s with a sharding: structure, shapes, dtypes and placement of the result.
    """
    step = latest_step(directory)
    if step is None:
        raise CheckpointError(f"no checkpoint in {directory}")
    abstract = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), template)
    try:
        with _manager(directory) as manager:
            return manager.restore(step, args=ocp.args.StandardRestore(abstract))
    except Exception as error:  # orbax and its storage layer raise many unrelated types
        raise CheckpointError(f"checkpoint {step} in {directory} cannot be restored: {error}") from error


def latest_step(directory: Path) -> int | None:
    """The step of the latest complete checkpoint, None without one."""
    if not directory.is_dir():
        return None
    with _manager(directory) as manager:
        return manager.latest_step()


def _manager(directory: Path) -> ocp.CheckpointManager:
    options = ocp.CheckpointManagerOptions(max_to_keep=1, enable_async_checkpointing=False)
    return ocp.CheckpointManager(directory.resolve(), options=options)
