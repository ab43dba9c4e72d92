"""Tables of BENCHMARKS.md and of the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: bool = False) -> str:
    """A Markdown table: a line of titles, the rule below them, and a line per row.

    Args:
      numbers: align every column but the first to the right.
    """
    other = "---:|" if numbers else "---|"
    return "\n".join((_line(header), "|---|" + other * (len(header) - 1), *map(_line, rows)))


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
