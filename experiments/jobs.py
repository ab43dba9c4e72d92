"""Jobs on Ray: each in a process of its own, somewhere on a cluster, and tried again if that process dies."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from typing import Any

from experiments.errors import UsageError

RETRIES = 3
"""How often a job is tried again; a job that goes on from its checkpoint may well need more than one try."""


def check_installed() -> None:
    """Raises a `UsageError` that names the extra if Ray is missing."""
    if importlib.util.find_spec("ray") is None:
        raise UsageError("--ray needs ray: pip install -e '.[ray]'")


def on_ray(work: Callable[..., int], jobs: Sequence[tuple[Any, ...]], *, cpus: int, gpus: float) -> list[int | Exception]:
    """What `work(*job)` returns for every job, or how it failed; a job that fails leaves the others alone.

    The cluster is the one that Ray finds (RAY_ADDRESS, or one started on this machine), else this machine.

    Args:
      work: repeats without harm what an earlier, killed call has done; it and the jobs are pickled.
      cpus: what Ray sets aside for each job.
      gpus: likewise; a job sees only its own.
    """
    import ray

    with ray.init():
        remote = ray.remote(num_cpus=cpus, num_gpus=gpus, max_calls=1, max_retries=RETRIES)(work)
        results: list[int | Exception] = []
        for reference in [remote.remote(*job) for job in jobs]:
            try:
                results.append(ray.get(reference))
            except ray.exceptions.RayError as error:
                results.append(error)
    return results
