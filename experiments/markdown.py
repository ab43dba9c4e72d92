"""Tables of BENCHMARKS.md and of the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table: a line of titles, the rule below them, and a line per row."""
    return "\n".join((_line(header), "|" + "---|" * len(header), *map(_line, rows)))


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
