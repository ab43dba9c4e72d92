"""Mistakes of the user, told in one line instead of a traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path


class UsageError(Exception):
    """A request that cannot be fulfilled as given; the message says why and what would be."""


def make_folder(file: Path | None) -> None:
    """Makes the directory that `file` is to be written to, before the work; raises a `UsageError` if there cannot be one."""
    if file:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{file.parent} is no directory and cannot be made one: {error}") from error


def exit_with(main: Callable[[], int]) -> None:
    """Ends the process with the exit code of `main`, or with 2 and one line on a `UsageError`."""
    try:
        code = main()
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    sys.exit(code)
