"""Sides of a comparison that are measured in turns, each in a process of its own that keeps what it has compiled."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

Begun = tuple[Callable[[], None], float]
"""What a measurement runs, and the seconds to compile it."""


class Worker:
    """A process of its own in which something goes on from one measurement to the next.

    Args:
      begin: a module's function that makes what is measured; called in the process with `details`.

    Attributes:
      compile_seconds: what `begin` says.
    """

    def __init__(self, begin: Callable[..., Begun], *details: Any) -> None:
        self._pool = ProcessPoolExecutor(max_workers=1, mp_context=multiprocessing.get_context("spawn"))
        self.compile_seconds = self._pool.submit(_begin, begin, *details).result()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown()

    def start(self) -> Future[float]:
        """Begins a measurement; the result is its seconds."""
        return self._pool.submit(_run)

    def run(self) -> float:
        """The seconds of a measurement."""
        return self.start().result()


_begun: list[Callable[[], None]] = []
"""In a worker's process, what it runs."""


def _begin(begin: Callable[..., Begun], *details: Any) -> float:
    run, compile_seconds = begin(*details)
    _begun.append(run)
    return compile_seconds


def _run() -> float:
    began = time.perf_counter()
    _begun[0]()
    return time.perf_counter() - began
