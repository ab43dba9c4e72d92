"""Look-up by name that helps whoever mistypes."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import SequenceMatcher
from typing import TypeVar

T = TypeVar("T")


def look_up(registry: Mapping[str, T], name: str, kind: str) -> T:
    """The entry `name`.

    Raises:
      ValueError: no such entry; the message names the closest one and all that are allowed.
    """
    if name in registry:
        return registry[name]
    closest = max(registry, key=lambda entry: SequenceMatcher(None, name.casefold(), entry.casefold()).ratio())
    raise ValueError(f"unknown {kind} {name!r}; closest is {closest!r}, allowed are {', '.join(sorted(registry))}")
