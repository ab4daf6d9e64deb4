"""`rtid history`: the changes of the model, points in time of what was learned, the calendar."""

from __future__ import annotations

import getpass
import json
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from rtid.cli.options import AsJson, ProjectOption


def _date(text: str | None) -> str | None:
    if text is not None:
        try:
            datetime.fromisoformat(text)
        except ValueError:
            raise typer.BadParameter(
                f"{text!r} is no date, 2026-11-23 or 2026-11-23T14:00"
            ) from None
    return text


def history(
    project: ProjectOption,
    days: Annotated[
        float | None,
        typer.Option(
            min=0.001, help="Hold what the daemon learned in so many days beside as many before."
        ),
    ] = None,
    until: Annotated[
        str | None, typer.Option(callback=_date, help="End of these days, a date; now.")
    ] = None,
    note: Annotated[str, typer.Option(help="Write this about these days, for whoever looks.")] = "",
    as_json: AsJson = False,
) -> str | None:
    """List the changes of the model, and the points in time that `rtid restore` goes back to.

    Of a change: date, effect, errors before and after, noise floor, reason.  Of a point: when and
    why the daemon kept it, and the key of the project file as it was then.  With --days: this week
    beside the last one, from the daemon's history, with what was noted about them.
    """
    from rtid.project.history import history as changes_of
    from rtid.project.history import standing, state_beside
    from rtid.tell.history import SCHEMA, plain, show_history, show_points
    from rtid.trace.points import points_of

    changes, folder = changes_of(project), state_beside(project)
    outcome = "changed" if standing(changes) else None
    if days is not None:
        _calendar(folder, days, until, note, as_json)
        return outcome
    if note or until:
        raise typer.BadParameter("--note and --until say something of --days")
    points = [(key.name, p) for key in sorted(folder.glob("*/")) for p in points_of(key)]
    if as_json:
        words = [
            {"name": p.path.stem, "unix_s": p.unix_s, "reason": p.reason, "bytes": p.size_bytes,
             "key": key}
            for key, p in points
        ]  # fmt: skip
        made = [plain(change) for change in changes]
        print(json.dumps({"schema": SCHEMA, "changes": made, "points": words}))
    else:
        show_history(changes)
        show_points([(p.path.stem, p.unix_s, p.reason, key) for key, p in points])
    return outcome


def _calendar(folder: Path, days: float, until: str | None, note: str, as_json: bool) -> None:
    """Two spans side by side; a note is written first."""
    from dataclasses import asdict

    from rtid.daemon.calendar import (
        SpanNote,
        calendar_table,
        notes,
        side_by_side,
        two_spans,
        write_note,
    )
    from rtid.tell.terminal import make_console

    end_s = None if until is None else datetime.fromisoformat(until).timestamp()
    before, now = two_spans(days, end_s)
    if note:
        write_note(folder, SpanNote(now.from_s, now.until_s, getpass.getuser(), note))
    rows, noted = side_by_side(folder, before, now), notes(folder, now)
    if as_json:
        document = {"schema": 1, "before": asdict(before), "now": asdict(now)}
        document |= {"rows": [asdict(r) for r in rows], "notes": [asdict(n) for n in noted]}
        print(json.dumps(document))
    else:
        console = make_console()
        console.print(calendar_table(days, rows))
        for one in noted:
            ends = [datetime.fromtimestamp(t).isoformat(" ", "minutes")
                    for t in (one.from_s, one.until_s)]  # fmt: skip
            console.print(f"{' to '.join(ends)}, {one.who}: {one.text}", soft_wrap=True)
