"""`rtid apply`: send a learned map to the controller, after showing what would change."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtid.cli.exits import Exit
from rtid.cli.options import AsJson, StateFolder, TestBus, UnitsOption
from rtid.errors import RtidError
from rtid.units import System

if TYPE_CHECKING:
    from rtid.apply.session import Plan
    from rtid.apply.versions import VersionRow


def apply(
    project: Annotated[Path, typer.Argument(help="Project file with a section `publish`.")],
    undo: Annotated[
        bool, typer.Option("--undo", help="Send back what was active before the last apply.")
    ] = False,
    again: Annotated[
        bool,
        typer.Option("--again", help="Send the last map to a controller that has forgotten it."),
    ] = False,
    map_file: Annotated[
        Path | None,
        typer.Option("--map", help="This map (.npz, .json) in place of the daemon's offer."),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(
            help="Trace to judge --map on, which must not have learned from it; with --dry-run and "
            "a section `controller`, the record on which tracking is foretold."
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Send nothing at all: show what the records say.")
    ] = False,
    bus: Annotated[
        str | None, typer.Option(help="INTERFACE:CHANNEL in place of the file's.")
    ] = None,
    state: StateFolder = None,
    log: Annotated[
        bool, typer.Option("--log", help="List what was sent, when and by whom; send nothing.")
    ] = False,
    replace_unknown: Annotated[
        bool,
        typer.Option("--replace-unknown", help="Even where the controller's map is not known."),
    ] = False,
    test_bus: TestBus = False,
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
) -> None:
    """Send the map that the daemon offers to the controller, all or nothing, and undo it.

    Asks the controller what it holds, shows the difference per valve, keeps the limits of the
    section `publish`, asks, and sends.  It becomes active at one moment, or not at all; then the
    controller is asked for version, CRC and flows.  Exit code 4 if nothing is offered, a limit
    forbids it, you say no, or it cannot be asked for flows.
    """
    from rtid.apply.session import apply_map
    from rtid.apply.wish import Wish
    from rtid.tell.applied import story
    from rtid.tell.terminal import make_console

    if log:
        _list(project, state, as_json)
        return
    wish = Wish(undo, again, map_file, against, dry_run, bus, state, replace_unknown, test_bus)

    def confirmed(plan: Plan) -> bool:
        if not as_json:
            make_console().print(story(plan))
        if plan.objections or plan.is_same or dry_run:
            return False
        if yes:
            return True
        if not sys.stdin.isatty():
            raise RtidError("nobody can be asked here", "add --yes in a script", Exit.USAGE)
        return typer.confirm("Send it?", default=False)

    with _bar() as progress:
        plan, row = apply_map(project, wish, confirmed, progress)
    _end(plan, row, as_json, dry_run)


def _list(project: Path, state: Path | None, as_json: bool) -> None:
    """All applies, the oldest first."""
    from rtid.apply.versions import Applied
    from rtid.project.folder import state_of
    from rtid.tell.applied import logged

    rows = Applied(state or state_of(project)).rows()
    if as_json:
        print(json.dumps([asdict(row) for row in rows]))
        return
    for row in rows:
        print(logged(row))


@contextmanager
def _bar() -> Iterator[Callable[[int, int], None]]:
    """A progress bar on a terminal, from the first chunk on."""
    from rich.console import Console
    from rich.progress import Progress

    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    shown = Progress(console=Console(stderr=True, markup=False, emoji=False), transient=True)
    task = shown.add_task("sending", start=False)

    def progress(done: int, total: int) -> None:
        shown.start()  # not before: there may be a question on the screen
        shown.start_task(task)
        shown.update(task, completed=done, total=total)

    try:
        yield progress
    finally:
        shown.stop()


def _end(plan: Plan, row: VersionRow | None, as_json: bool, dry_run: bool) -> None:
    from rtid.tell.applied import ending

    if as_json:
        document: dict[str, Any] = plan.as_json()
        document |= {"applied": None if row is None else _applied(row)}
        document |= {"verified": None if plan.verified is None else asdict(plan.verified)}
        print(json.dumps(document))
    elif text := ending(plan, row):
        print(text)
    for text in plan.objections:
        print(f"rtid: refused: {text}", file=sys.stderr)
    is_short = not plan.is_same if row is None else not row.is_verified
    if is_short and not dry_run:
        raise typer.Exit(Exit.NEGATIVE)


def _applied(row: VersionRow) -> dict[str, Any]:
    """What was done, for `--json`."""
    verified = row.told.get("verified")
    return {"version": row.version, "who": row.who, "outcome": row.outcome, "verified": verified}
