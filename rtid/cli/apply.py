"""`rtid apply`: send a learned map to the controller, after showing what would change."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtid.cli.exits import Exit
from rtid.errors import RtidError

if TYPE_CHECKING:
    from rtid.applied import Row
    from rtid.apply_session import Plan


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
        typer.Option(help="Trace to judge --map on; the map must not have learned from it."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Send nothing at all: show what the records say.")
    ] = False,
    bus: Annotated[
        str | None, typer.Option(help="INTERFACE:CHANNEL in place of the file's.")
    ] = None,
    state: Annotated[
        Path | None, typer.Option(help="State folder of the daemon; else the file's.")
    ] = None,
    log: Annotated[
        bool, typer.Option("--log", help="List what was sent, when and by whom; send nothing.")
    ] = False,
    replace_unknown: Annotated[
        bool,
        typer.Option("--replace-unknown", help="Even where the controller's map is not known."),
    ] = False,
    test_bus: Annotated[
        bool, typer.Option("--test-bus", help="Allow udp_multicast and virtual: no authentication.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Send the map that the daemon offers to the controller, all or nothing, and undo it.

    Asks the controller what it holds, shows the difference per valve, keeps the limits of the
    section `publish`, asks, and sends.  It becomes active at one moment, or not at all.  Exit code
    4 if nothing is offered, a limit forbids it, or you say no.
    """
    from rtid.apply_session import apply_map
    from rtid.wished import Wish

    if log:
        _list(project, state, as_json)
        return
    wish = Wish(undo, again, map_file, against, dry_run, bus, state, replace_unknown, test_bus)

    def confirmed(plan: Plan) -> bool:
        if not as_json:
            _show(plan)
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
    from rtid.applied import Applied
    from rtid.daemon.configure import state_of

    rows = Applied(state or state_of(project)).rows()
    if as_json:
        print(json.dumps([asdict(row) for row in rows]))
        return
    for row in rows:
        when = datetime.fromtimestamp(row.unix_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        changes = [abs(e["largest_m3s"]) for e in row.told.get("edges", ()) if e["largest_m3s"]]
        largest = f"largest change {6e4 * max(changes):.2f} L/min" if changes else "the first"
        again = "" if row.content == row.version else f", the maps of version {row.content}"
        print(f"{when}  version {row.version}{again}: {row.outcome}, by {row.who}, {largest}")


@contextmanager
def _bar() -> Iterator[Callable[[int, int], None]]:
    """A progress bar on a terminal, from the first chunk on."""
    from rich.console import Console
    from rich.progress import Progress

    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    shown = Progress(console=Console(stderr=True), transient=True)
    task = shown.add_task("sending", start=False)

    def progress(done: int, total: int) -> None:
        shown.start()  # not before: there may be a question on the screen
        shown.start_task(task)
        shown.update(task, completed=done, total=total)

    try:
        yield progress
    finally:
        shown.stop()


def _end(plan: Plan, row: Row | None, as_json: bool, dry_run: bool) -> None:
    if as_json:
        told: dict[str, Any] = plan.as_json()
        told |= {"applied": None if row is None else {"version": row.version, "who": row.who}}
        print(json.dumps(told))
    elif row is not None:
        print(f"active: version {row.version}.  Back with `rtid apply --undo`.")
    elif plan.is_same:
        print("The controller holds exactly this: nothing to send.")
    elif not plan.objections:
        print("Nothing was sent.")
    for text in plan.objections:
        print(f"rtid: refused: {text}", file=sys.stderr)
    if row is None and not plan.is_same and not dry_run:
        raise typer.Exit(Exit.NEGATIVE)


def _show(plan: Plan) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, soft_wrap=True)
    found = plan.review
    console.print(plan.why)
    console.print(plan.held_text)
    table = Table(
        "valve", "largest L/min", "at V", "MPa", "rms", "on data", "% rated", "valid %", "table %",
        box=None,
    )  # fmt: skip
    errors = {one.edge: one for one in plan.prepared.sampled}
    for one in found.differences:
        error = errors.get(one.edge)
        table.add_row(
            one.edge,
            _number(6e4 * one.largest_m3s, "+.2f"),
            _number(one.u_v, ".2f"),
            _number(1e-6 * one.dp_pa, ".2f"),
            _number(6e4 * one.rms_m3s, ".3f"),
            _number(6e4 * one.believed_m3s, "+.2f"),
            _number(one.believed_percent, ".1f"),
            f"{100 * one.valid_before:.0f} -> {100 * one.valid:.0f}",
            "-" if error is None else f"{100 * error.error_max_m3s / one.rated_m3s:.3f}",
        )
    console.print(table)
    console.print(
        "on data: largest change where the old or the new map stands on data, and its share of the "
        "rated flow; valid: share of the plane of u and dp; table: what the look-up table is off by"
    )
    for chamber, old, new in found.beta_pa:
        before = "none" if old is None else f"{1e-6 * old:.1f}"
        console.print(f"bulk modulus {chamber}: {before} -> {1e-6 * new:.1f} MPa")
    if not plan.is_same:
        size = sum(len(data) for data in plan.prepared.images.values())
        console.print(f"would be version {found.version}: {size} bytes")


def _number(value: float, form: str) -> str:
    return format(value, form) if value == value else "-"  # noqa: PLR0124
