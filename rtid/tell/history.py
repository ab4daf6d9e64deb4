"""The history of a project's model as a user reads it; needs neither numbers nor a trace."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rtid.project.history import UNDO, Change, standing
from rtid.tell.story import Table
from rtid.tell.terminal import make_console
from rtid.tell.words import is_floor

SCHEMA = 1


def show_history(changes: Sequence[Change]) -> None:
    """Print the table of all changes."""
    nothing = "no change yet: `rtid add` makes the first"
    make_console().print(history_table(changes) if changes else nothing)


def history_table(changes: Sequence[Change]) -> Table:
    """What was added and dropped, and what it brought."""
    alive, rows = {change.number for change in standing(changes)}, []
    for c in changes:
        taken_back = c.change != UNDO and c.number not in alive
        rows.append((
            str(c.number),
            c.date[:10],
            f"{c.change} {c.effect}:{c.where}" + (" (taken back)" if taken_back else ""),
            _arrow(c.errors.get("identification_pct", {})),
            _arrow(c.errors.get("heldout_pct", {})),
            f"{floor:.2f}" if is_floor(floor := c.errors.get("noise_floor_pct")) else "",
            c.reason,
        ))  # fmt: skip
    heads = ("|", "date", "change", "identification|", "held-out|", "floor|", "reason~")
    return Table("history: errors in % of the rms flow", heads, rows)


def show_points(points: Sequence[tuple[str, float, str, str]]) -> None:
    """Print the points in time: name, time (s since 1970), reason, key of the project file."""
    if not points:
        return
    rows = [
        (name, time.strftime("%F %T", time.localtime(unix_s)), reason, key)
        for name, unix_s, reason, key in points
    ]
    title = "points in time of what was learned: rtid restore -p PROJECT POINT"
    make_console().print(Table(title, ("point", "kept at", "why", "project as of"), rows))


def _arrow(pair: Mapping[str, float]) -> str:
    return f"{pair['before']:.2f} -> {pair['after']:.2f}" if len(pair) == 2 else ""


def plain(change: Change) -> dict[str, Any]:
    """A change without the text of the file."""
    return {k: v for k, v in asdict(change).items() if k not in ("before", "after_sha256")}
