"""Ctrl-C and SIGTERM as a polite request."""

from __future__ import annotations

import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from types import FrameType, TracebackType
from typing import Any, TypeVar

T = TypeVar("T")

EXIT_CODE = 130
"""What shells expect of a process that ended on Ctrl-C."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_POLL_SECONDS = 0.1


class Interrupt:
    """Within it, the first signal only sets `requested`; a second one kills at once."""

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupt:
        self._previous = {number: signal.signal(number, self._request) for number in _SIGNALS}
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_DFL)

    def run(self, work: Callable[[], T], on_request: Callable[[], None]) -> T:
        """`work()` in a thread, because Python handles signals only while its main thread is not inside XLA.

        Args:
          on_request: called once if a request comes meanwhile, or came just before; the work goes on.
        """
        with ThreadPoolExecutor(max_workers=1) as pool:
            future = pool.submit(work)
            told = False
            while wait([future], timeout=_POLL_SECONDS).not_done:
                if self.requested and not told:
                    on_request()
                    told = True
            return future.result()
