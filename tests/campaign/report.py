"""Figures of the campaigns: each one leaves a line, the table of docs/figures.md shows them all.

python -m tests.campaign.report [docs/figures.md]   (`make campaign` does)
"""

from __future__ import annotations

import json
import re
import sys
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.table import replace_between

FOLDER = Path(__file__).parents[2] / "out" / "campaign"
MARKER = "campaign"
HEAD = "| | measured | must | over |\n|---|---|---|---|\n"


def leave(what: str, figure: str, limit: str, basis: str) -> None:
    """Keep one line of the table: what was asked, what came out, what it must be, over what."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    name = "".join(c if c.isalnum() else "_" for c in what.lower())[:80]
    line = {"what": what, "figure": figure, "limit": limit, "basis": basis}
    (FOLDER / f"{name}.json").write_text(json.dumps(line))


def table(before: str) -> str:
    """Markdown of all lines that were left; rows of before that were not run again stay."""
    head, _, rows = before.partition(HEAD)
    kept = {row.split("|")[1].strip(): row for row in rows.splitlines() if row.strip()}
    for path in sorted(FOLDER.glob("*.json")):
        x = json.loads(path.read_text())
        kept[x["what"]] = f"| {x['what']} | {x['figure']} | {x['limit']} | {x['basis']} |"
    day = datetime.now(UTC).date().isoformat()
    said = re.sub(r"Newest run on [0-9-]+", f"Newest run on {day}", head).strip("\n")
    return "\n".join([said, "", HEAD.strip("\n"), *kept.values()])


def main(arguments: list[str]) -> None:
    """Rewrite the page's table."""
    page = Path(arguments[0] if arguments else "docs/figures.md")
    text = page.read_text()
    before = text.partition(f"<!-- {MARKER}:begin -->")[2].partition(f"<!-- {MARKER}:end -->")[0]
    page.write_text(replace_between(text, MARKER, table(before)))


if __name__ == "__main__":
    main(sys.argv[1:])
