"""BENCHMARKS.md says what the results in the repository say."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from experiments import document
from experiments.errors import UsageError

ROOT = Path(__file__).parent.parent


def test_the_tables_are_those_of_the_results():
    text = (ROOT / "BENCHMARKS.md").read_text()
    assert text.count("<!-- table: ") == text.count(document.END) > 15
    assert document.fill(text, ROOT / "experiments" / "results") == text


def test_every_result_of_a_benchmark_stands_in_the_text():
    text = (ROOT / "BENCHMARKS.md").read_text()
    for path in (ROOT / "experiments" / "results" / "benchmarks").glob("*.json"):
        assert re.search(rf"<!-- table: benchmark [^>]*\b{path.stem}\b", text), path.stem


def test_a_table_takes_the_place_of_the_old_one(tmp_path):
    (tmp_path / "benchmarks").mkdir()
    content = {"settings": {"quick": False}, "text": ["| a |", "| 1 |"]}
    (tmp_path / "benchmarks" / "fast.json").write_text(json.dumps(content))
    old = f"before\n\n<!-- table: benchmark fast -->\n| stale |\n{document.END}\n\nafter <!-- a remark -->\n"
    new = f"before\n\n<!-- table: benchmark fast -->\n| a |\n| 1 |\n{document.END}\n\nafter <!-- a remark -->\n"
    assert document.fill(old, tmp_path) == document.fill(new, tmp_path) == new


@pytest.mark.parametrize(
    ("mark", "message"),
    [("guess it", "must be one of"), ("benchmark none", "none.json is not there"), ("benchmark tiny", "--quick")],
)
def test_a_mark_that_cannot_be_filled_is_named(tmp_path, mark, message):
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks" / "tiny.json").write_text(json.dumps({"settings": {"quick": True}, "text": ["| a |"]}))
    with pytest.raises(UsageError, match=message):
        document.fill(f"<!-- table: {mark} -->\n{document.END}\n", tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        f"<!-- table: benchmark one -->\nno end, then prose\n\n<!-- table: benchmark two -->\n{document.END}\n",
        f"<!-- table: benchmark one --> \n{document.END}\n",
        f"<!-- table: benchmark -->\n{document.END}\n",
        f"prose\n{document.END}\n",
    ],
)
def test_no_prose_is_lost_to_a_comment_gone_wrong(tmp_path, text):
    with pytest.raises(UsageError, match="comments begin a table"):
        document.fill(text, tmp_path)
