"""The table of `make faults` has all rows, and no row is silent."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.faults.elsewhere import ELSEWHERE, IN_SOAK, NOT_TESTED, files
from tests.faults.table import NAMES, main, table

ROOT = Path(__file__).parents[1]


def rows_with_a_figure() -> set[int]:
    """Rows that some test of `make faults` or `make soak` notes a figure of."""
    texts = (path.read_text("utf-8") for path in (ROOT / "tests" / "faults").glob("test_*.py"))
    return {int(row) for text in texts for row in re.findall(r"figure\(\s*(\d+),", text)}


def test_every_row_is_tested_somewhere_or_says_why_not() -> None:
    assert list(NAMES) == list(range(1, 41))
    known = rows_with_a_figure() | set(ELSEWHERE) | set(IN_SOAK) | set(NOT_TESTED)
    assert not set(NAMES) - known
    assert not set(NOT_TESTED) & (rows_with_a_figure() | set(ELSEWHERE)), "it is tested now"


def test_what_stands_elsewhere_is_there() -> None:
    assert all((ROOT / file).is_file() for file in files())


def test_every_row_has_a_line_whatever_ran() -> None:
    for figures in ([], [{"row": 1, "what": "drift", "value": 0.5, "wanted": "<= 1", "unit": "%",
                          "met": True, "test": "tests/faults/test_frames.py::a"}]):  # fmt: skip
        lines = table(figures).splitlines()[2:]
        assert {int(line.split("|")[1]) for line in lines} == set(NAMES)
        assert all(line.count("|") == 7 for line in lines)


def test_a_test_that_failed_elsewhere_is_seen() -> None:
    file = ELSEWHERE[31][1][0]
    figures: list[dict[str, object]] = [
        {"test": f"{file}::a", "passed": True}, {"test": f"{file}::b", "passed": False},
    ]  # fmt: skip
    line = next(t for t in table(figures).splitlines() if t.startswith("| 31 "))
    assert "1 of 2 tests pass" in line and "NOT MET" in line
    line = next(t for t in table(figures[:1]).splitlines() if t.startswith("| 31 "))
    assert "1 of 1 tests pass" in line and line.endswith("| ok |")


def test_a_test_that_failed_before_it_had_a_figure_is_seen() -> None:
    """In each row of its name, or in none; a figure that is not met says it already."""
    file = "tests/faults/test_process.py"
    failed: list[dict[str, object]] = [
        {"test": f"{file}::test_row_9_and_10_stalled[2]", "passed": False},
        {"test": f"{file}::test_a_run", "passed": False},
        {"test": f"{file}::test_row_18_disk_full", "passed": True},
        {"test": f"{file}::test_row_22_hang", "passed": False},
        {"row": 22, "what": "x", "value": 9.0, "wanted": "<= 1", "unit": "s", "met": False,
         "test": f"{file}::test_row_22_hang"},
    ]  # fmt: skip
    lines = [line for line in table(failed).splitlines() if "NOT MET" in line]
    assert [line.split("|")[1].strip() for line in lines] == ["9", "10", "22", ""]
    assert all("test_row_9_and_10_stalled[2] failed" in line for line in lines[:2])
    assert "test_a_run failed" in lines[3] and all(line.count("|") == 7 for line in lines)


def test_what_make_soak_has_left_stands_in_the_same_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether it has run here or not."""
    figure = {"row": 21, "what": "normal again", "value": 0.4, "wanted": "<= 1", "unit": "s",
              "met": True, "test": "b"}  # fmt: skip
    names = [str(tmp_path / name) for name in ("faults.jsonl", "soak.jsonl")]
    monkeypatch.setattr("sys.argv", ["table", *names])
    main()
    assert "| in `make soak` |" in capsys.readouterr().out
    Path(names[1]).write_text(json.dumps(figure))
    main()
    line = next(t for t in capsys.readouterr().out.splitlines() if t.startswith("| 21 "))
    assert "normal again (`make soak`, 20" in line and line.endswith("| 0.4 s | <= 1 | ok |")


def test_a_row_whose_tests_did_not_run_is_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor one of whose files none ran; the paths are those of the folder that make began in."""
    passed = [{"test": f"{file}::a", "passed": True} for file in files()]
    figures = [{"row": row, "what": "x", "value": 0.0, "wanted": "<= 1", "unit": "", "met": True,
                "test": "b"} for row in NAMES]  # fmt: skip
    noted = tmp_path / "figures.jsonl"
    monkeypatch.setattr("sys.argv", ["table", str(noted), "--all"])
    noted.write_text("\n".join(json.dumps(entry) for entry in [*figures, *passed]))
    main()
    for short in (figures[1:] + passed[1:], [*figures, *passed[:-1]], [*figures, *passed[1:]]):
        noted.write_text("\n".join(json.dumps(entry) for entry in short))
        with pytest.raises(SystemExit, match="1"):
            main()
    makefile = (ROOT / "Makefile").read_text("utf-8")
    assert makefile.count("RTID_FAULTS=$(CURDIR)/") == makefile.count("RTID_FAULTS=") == 2
