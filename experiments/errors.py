"""Mistakes of the user, told in one line instead of a traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path


class UsageError(Exception):
    """A request that cannot be fulfilled as given; the message says why and what would be."""


PICTURES = (".png", ".pdf", ".svg", ".jpg")
"""Suffixes of the pictures that matplotlib writes."""


def check_output(file: Path | None, suffixes: Sequence[str]) -> None:
    """Makes the directory that `file` is to be written to, before the work.

    Raises:
      UsageError: there cannot be one, or the file is a directory, or its name ends otherwise than one of `suffixes`.
    """
    if file:
        if file.is_dir():
            raise UsageError(f"{file} is a directory; name the file to write")
        if file.suffix.lower() not in suffixes:
            raise UsageError(f"{file} must end in {' or '.join(suffixes)}")
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
