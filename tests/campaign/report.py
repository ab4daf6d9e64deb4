"""Figures of the campaigns: each one leaves a line, the table of docs/figures.md shows them all.

python -m tests.campaign.report [docs/figures.md]   (`make campaign` does)
"""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.table import replace_between

FOLDER = Path(__file__).parents[2] / "out" / "campaign"
MARKER = "campaign"


def leave(what: str, figure: str, limit: str, basis: str) -> None:
    """Keep one line of the table: what was asked, what came out, what it must be, over what."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    name = "".join(c if c.isalnum() else "_" for c in what.lower())[:80]
    line = {"what": what, "figure": figure, "limit": limit, "basis": basis}
    (FOLDER / f"{name}.json").write_text(json.dumps(line))


def table() -> str:
    """Markdown of all lines that were left."""
    lines = [json.loads(path.read_text()) for path in sorted(FOLDER.glob("*.json"))]
    rows = [f"| {x['what']} | {x['figure']} | {x['limit']} | {x['basis']} |" for x in lines]
    day = datetime.now(UTC).date().isoformat()
    head = f"Written by `make campaign` on {day}.\n"
    return "\n".join([head, "| | measured | must | over |", "|---|---|---|---|", *rows])


def main(arguments: list[str]) -> None:
    """Rewrite the page's table."""
    readme = Path(arguments[0] if arguments else "docs/figures.md")
    readme.write_text(replace_between(readme.read_text(), MARKER, table()))


if __name__ == "__main__":
    main(sys.argv[1:])
