"""Several processes, usually one per host, that train the lanes of one experiment together.

Every process runs the same program and calls the same functions in the same order; the first alone writes files other than
checkpoints, and speaks.  A process by itself is the first and only one.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from experiments.errors import UsageError

T = TypeVar("T")

_SHUTDOWN_SECONDS = 3600
"""How long the others wait at the end for the first one, which draws the pictures."""


def join(coordinator_address: str | None, num_processes: int | None, process_id: int | None) -> None:
    """Meets the other processes, before JAX starts its backend; what is None, JAX finds out on the clusters that it knows.

    Raises:
      UsageError: something is None on no such cluster, or the processes' devices differ in number.
    """
    try:
        jax.distributed.initialize(coordinator_address, num_processes, process_id, shutdown_timeout_seconds=_SHUTDOWN_SECONDS)
    except ValueError as error:
        raise UsageError(
            f"--distributed finds no cluster that JAX knows, so that it needs --coordinator-address, --num-processes and "
            f"--process-id: {error}"
        ) from error
    devices = Counter(device.process_index for device in jax.devices())
    if len(set(devices.values())) > 1:
        counts = " ".join(str(devices[process]) for process in sorted(devices))
        raise UsageError(f"all processes need the same number of devices, got {counts}; on CPU --devices sets it")


def is_first() -> bool:
    """Whether this process writes the files."""
    return jax.process_index() == 0


def gather(tree: Any) -> Any:
    """Arrays of which every process may hold a part, as whole numpy arrays in every process."""
    jax.block_until_ready(tree)
    return multihost_utils.process_allgather(tree, tiled=True)


def any_of(flag: bool) -> bool:
    """Whether the flag is set in any process."""
    return bool(gather(np.array([flag])).any())


def together(work: Callable[[], T]) -> T:
    """What `work` returns in this process; if it fails in one, it fails in all.

    Raises:
      UsageError: where it did not fail itself.
    """
    try:
        value = work()
    except Exception:  # whatever it is, the others must not wait for this process
        any_of(True)
        raise
    if any_of(False):
        raise UsageError("stopped, because another process did")
    return value


def from_first(work: Callable[[], int | None]) -> int:
    """What `work` returns in the first process, where alone it is done, 0 for nothing; raises as `together`."""
    value = together(lambda: work() if is_first() else None)
    return int(gather(np.array([value or 0], np.int32))[0])


def check_same(what: str) -> None:
    """Raises a `UsageError` in every process unless `what` is the same text in all."""
    if len(set(gather(np.array([zlib.crc32(what.encode())], np.uint32)).tolist())) > 1:
        raise UsageError("the processes were started with different options; give all of them the same, but for --process-id")
