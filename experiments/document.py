"""Writes the tables of BENCHMARKS.md and the figures above them anew: `python -m experiments.document`.

A table stands between two comments, of which the first says what it is made of, all of it in `experiments/results`:

    <!-- table: benchmark NAME [NAME ...] -->             what the scripts printed that wrote benchmarks/NAME.json
    <!-- table: report FIGURE.png RUN [RUN ...] -->       `experiments.report` of runs; FIGURE.png shows their target return,
                                                          or with METRIC=NAME among the words that metric
    <!-- table: signs RUN [RUN ...] -->                   `experiments.signs` of runs
    <!-- table: contrast STEPS A[+B...]:C[+D...] [...] -->  `experiments.contrast` of the runs A, B, ... with C, D, ... up to
                                                          STEPS, a line for each pair of sets
    <!-- end of table -->
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from experiments import contrast, markdown, plots, report, signs
from experiments.errors import UsageError, exit_with

END = "<!-- end of table -->"
"""The second comment."""

_MARK = "<!-- table: "
_TABLE = re.compile(
    rf"(?P<begin>{_MARK}(?P<kind>\S+) (?P<names>[^>]*?) -->\n)(?:(?!{_MARK}).)*?(?P<end>{re.escape(END)})", re.DOTALL
)


@dataclass(frozen=True)
class Document:
    """Fill a document's marked tables.

    Attributes:
      path: the Markdown file.
      results: where runs and benchmarks/ are, and where figures go.
    """

    path: Path = Path("BENCHMARKS.md")
    results: Path = Path("experiments/results")


def main() -> int:
    """The command line."""
    document = tyro.cli(Document, prog="python -m experiments.document", description=__doc__)
    if not document.path.is_file():
        raise UsageError(f"--path {document.path} is no file")
    before = document.path.read_text()
    after = fill(before, document.results)
    draw(after, document.results)
    document.path.write_text(after)
    print(f"{document.path}: {len(_TABLE.findall(after))} tables, {'changed' if after != before else 'as they were'}")
    return 0


def fill(text: str, results: Path) -> str:
    """A document with every marked table made anew.

    Raises:
      UsageError: a mark that says nothing known or has no end, an end without a mark, or results that are not there.
    """
    tables = len(_TABLE.findall(text))
    if not tables == text.count(_MARK) == text.count(END):
        raise UsageError(
            f"{text.count(_MARK)} comments begin a table and {text.count(END)} end one, but only {tables} pairs read "
            f"{_MARK}KIND NAME [NAME ...] -->, on a line of its own, and {END}"
        )

    def table(match: re.Match[str]) -> str:
        if match["kind"] not in TABLES:
            raise UsageError(f"{match['begin'].strip()}: {match['kind']!r} must be one of {', '.join(TABLES)}")
        return f"{match['begin']}{TABLES[match['kind']](match['names'].split(), results).strip()}\n{match['end']}"

    return _TABLE.sub(table, text)


def draw(text: str, results: Path) -> None:
    """The figure of every marked report."""
    for match in _TABLE.finditer(text):
        if match["kind"] == "report":
            figure, runs, metrics = _parse_report(match["names"].split(), results)
            plots.comparison(figure, {"": report.read(runs)}, metrics=metrics or report.Report.metrics)


def _benchmark(names: Sequence[str], results: Path) -> str:
    texts = []
    for path in (results / "benchmarks" / f"{name}.json" for name in names):
        if not path.is_file():
            raise UsageError(f"{path} is not there; python -m experiments.benchmarks writes it")
        content = json.loads(path.read_text())
        if content["settings"]["quick"]:
            raise UsageError(f"{path} was measured with --quick, its numbers mean nothing")
        texts.append("\n".join(content["text"]))
    return "\n\n".join(texts)


def _report(names: Sequence[str], results: Path) -> str:
    _, runs, _ = _parse_report(names, results)
    return report.table(report.read(runs))


def _parse_report(names: Sequence[str], results: Path) -> tuple[Path, list[Path], list[str]]:
    """The figure, the runs, and the metrics."""
    figure, *words = names
    metrics = [word.removeprefix("METRIC=") for word in words if word.startswith("METRIC=")]
    return results / figure, [results / word for word in words if not word.startswith("METRIC=")], metrics


def _signs(names: Sequence[str], results: Path) -> str:
    return signs.table([results / run for run in names])


def _contrast(names: Sequence[str], results: Path) -> str:
    steps, *pairs = names
    if not steps.isdecimal() or not pairs or any(pair.count(":") != 1 for pair in pairs):
        raise UsageError(f"a contrast reads STEPS A[+B...]:C[+D...], got {' '.join(names)}")
    sets = [[[results / run for run in side.split("+")] for side in pair.split(":")] for pair in pairs]
    return markdown.table(contrast.HEADER, [contrast.cells(first, second, int(steps)) for first, second in sets])


TABLES: Mapping[str, Callable[[Sequence[str], Path], str]] = {
    "benchmark": _benchmark,
    "contrast": _contrast,
    "report": _report,
    "signs": _signs,
}
"""By the first word of a mark, the table of the other words."""


if __name__ == "__main__":
    exit_with(main)
