"""All faults as one table: `python -m tests.faults.table FIGURES.jsonl` (see `make faults`)."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from tests.faults.elsewhere import ELSEWHERE

NAMES = {
    1: "random frame loss", 2: "burst loss", 3: "duplicate, swapped, repeated", 4: "corrupted",
    5: "second sender", 6: "frozen sensor; change in the plant", 7: "saturated, not available",
    8: "wrong unit or sign", 9: "stalled reader", 10: "backlog", 11: "bus-off",
    12: "adapter unplugged", 13: "line noise", 14: "flood, full bus", 15: "cut log",
    16: "flipped log", 17: "killed while saving", 18: "disk full or slow",
    19: "state of another", 20: "clock steps", 21: "overload", 22: "hang", 23: "kernel cache",
    24: "no excitation", 25: "wrong configuration", 26: "browser attacks", 27: "writes by mistake",
    28: "hours",
}  # fmt: skip


def table(figures: list[dict[str, object]]) -> str:
    """Markdown: per row its figures, the worst of each kind, and where else it is tested."""
    lines = ["| # | fault | what | measured | wanted | |", "|---|---|---|---|---|---|"]
    for row, name in NAMES.items():
        mine = [entry for entry in figures if entry["row"] == row]
        for entry in mine:
            met = "ok" if entry["met"] else "**NOT MET**"
            lines.append(
                f"| {row} | {name} | {entry['what']} | {float(str(entry['value'])):.4g} "
                f"{entry['unit']} | {entry['wanted']} | {met if entry['wanted'] else ''} |"
            )
        if row in ELSEWHERE:
            what, where = ELSEWHERE[row]
            lines.append(f"| {row} | {name} | {what} | {', '.join(where)} | | see there |")
        elif not mine:
            lines.append(f"| {row} | {name} | not run | | | |")
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    path = Path(sys.argv[1])
    text = path.read_text("utf-8") if path.exists() else ""
    print(table([json.loads(line) for line in text.splitlines()]))


if __name__ == "__main__":
    main()
