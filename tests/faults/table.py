"""All faults as one table: `python -m tests.faults.table FIGURES.jsonl... [--all]`; `make faults`.

Each row has its figures, or how many of its tests passed elsewhere, or says why it has none; a test
that failed before it had a figure is named.  With --all it ends with 1 where a row has missed a
figure, a test has failed, or tests of a row did not run.
"""

from __future__ import annotations

import json
import re
import sys
from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path

from tests.faults.elsewhere import ELSEWHERE, IN_SOAK, NOT_TESTED

NAMES = {
    1: "random frame loss", 2: "burst loss", 3: "duplicate, swapped, repeated", 4: "corrupted",
    5: "second sender", 6: "frozen sensor; change in the plant", 7: "saturated, not available",
    8: "wrong unit or sign", 9: "stalled reader", 10: "backlog", 11: "bus-off",
    12: "adapter unplugged", 13: "line noise", 14: "flood, full bus", 15: "cut log",
    16: "flipped log", 17: "killed while saving", 18: "disk full or slow",
    19: "state of another", 20: "clock steps", 21: "overload", 22: "hang", 23: "kernel cache",
    24: "no excitation", 25: "wrong configuration", 26: "browser attacks", 27: "writes by mistake",
    28: "hours", 29: "faulty at the start", 30: "project A, B, A; accept twice",
    31: "stranger's project with code", 32: "lying controller, absurd map",
    33: "disk really full, power cut", 34: "container that swells",
    35: "FIFO, folder, link in the state folder", 36: "periods of any length",
    37: "other users, many pages", 38: "odd captures", 39: "babbling node",
    40: "clock steps, stop, two daemons",
}  # fmt: skip


NOT_MET, NOT_RUN = "**NOT MET**", "**NOT RUN**"
HERE = "tests/faults/"
SOAK = "soak"  # file of the figures of `make soak`
NO_ROW = 0  # of tests whose name says none


def table(figures: list[dict[str, object]]) -> str:
    """Markdown: per row its figures, what passed elsewhere, or why there is nothing."""
    passed, silent = _passed(figures), _failed_silently(figures)
    lines = ["| # | fault | what | measured | wanted | |", "|---|---|---|---|---|---|"]
    for row, name in NAMES.items():
        failed = silent.get(row, [])
        lines += [f"| {row} | {name} | {told} |" for told in _of(row, figures, passed, failed)]
    lines += [f"| | of no row | {failed} |" for failed in silent.get(NO_ROW, ())]
    return "\n".join(lines)


def _failed_silently(figures: list[dict[str, object]]) -> dict[int, list[str]]:
    """Tests that failed without a figure that is not met, by the rows that their names say."""
    judged = {entry["test"] for entry in figures if entry.get("met") is False}
    failed = {str(entry["test"]) for entry in figures if entry.get("passed") is False} - judged
    by_row = defaultdict[int, list[str]](list)
    for test in sorted(test for test in failed if test.startswith(HERE)):
        name = test.rpartition("::")[2]
        rows = re.match(r"test_row((?:_and|_\d+)+)_", name)
        for row in map(int, re.findall(r"\d+", rows[1]) if rows else [NO_ROW]):
            by_row[row].append(f"{name} failed | | | {NOT_MET}")
    return by_row


def _of(
    row: int, figures: list[dict[str, object]], passed: dict[str, list[bool]], failed: list[str]
) -> list[str]:
    """What is said of one row, each in the last four columns."""
    lines = list(failed)
    for entry in (entry for entry in figures if entry.get("row") == row):
        met = "ok" if entry["met"] else NOT_MET
        lines.append(
            f"{entry['what']} | {float(str(entry['value'])):.4g} {entry['unit']} | "
            f"{entry['wanted']} | {met if entry['wanted'] else ''}"
        )
    if row in ELSEWHERE:
        what, where = ELSEWHERE[row]
        outcomes = [outcome for file in where for outcome in passed.get(file, ())]
        is_whole = all(passed.get(file) for file in where)
        met = NOT_MET if not all(outcomes) else "ok" if is_whole else NOT_RUN
        count = f"{sum(outcomes)} of {len(outcomes)} tests pass"
        lines.append(f"{what} ({', '.join(where)}) | {count} | all | {met}")
    if row in IN_SOAK and not lines:
        lines.append(f"{IN_SOAK[row]} | | | in `make soak`")
    if not lines:
        lines.append(f"{NOT_TESTED.get(row, 'its test did not run')} | | | {NOT_RUN}")
    return lines


def _passed(figures: list[dict[str, object]]) -> dict[str, list[bool]]:
    """Outcomes of the tests that ran, by file."""
    by_file: dict[str, list[bool]] = defaultdict(list)
    for entry in figures:
        if "passed" in entry:
            by_file[str(entry["test"]).partition("::")[0]].append(bool(entry["passed"]))
    return by_file


def noted(path: Path) -> list[dict[str, object]]:
    """Figures of a run, with its day beside those of another command; none where it never ran."""
    if not path.exists():
        return []
    figures = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    day = datetime.fromtimestamp(path.stat().st_mtime, UTC).date().isoformat()
    for entry in figures:
        if path.stem == SOAK and "what" in entry:
            entry["what"] = f"{entry['what']} (`make soak`, {day})"
    return figures


def main() -> None:
    """Print the table; with --all, end with 1 where it is not as it must be."""
    paths = [Path(word) for word in sys.argv[1:] if not word.startswith("--")]
    told = table([entry for path in paths for entry in noted(path)])
    print(told)
    if "--all" in sys.argv and (NOT_MET in told or NOT_RUN in told):
        sys.exit(1)


if __name__ == "__main__":
    main()
