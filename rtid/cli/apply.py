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
from rtid.cli.options import UnitsOption
from rtid.errors import RtidError
from rtid.units import System, scale_of, with_unit

NOT_ASKED = (
    "its receiver is older than the question for a flow: compile firmware_bridge/c anew to be sure"
)

if TYPE_CHECKING:
    from rtid.apply.session import Plan
    from rtid.apply.versions import VersionRow
    from rtid.tell.story import Table


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
    from rtid.apply.versions import Applied
    from rtid.project.folder import state_of

    rows = Applied(state or state_of(project)).rows()
    if as_json:
        print(json.dumps([asdict(row) for row in rows]))
        return
    for row in rows:
        when = datetime.fromtimestamp(row.unix_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        changes = [abs(e["largest_m3s"]) for e in row.told.get("edges", ()) if e["largest_m3s"]]
        largest = "the first"
        if changes:
            largest = f"largest change {with_unit(max(changes), 'm3/s')}"
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
    if as_json:
        document: dict[str, Any] = plan.as_json()
        document |= {"applied": None if row is None else _applied(row)}
        document |= {"verified": None if plan.verified is None else asdict(plan.verified)}
        print(json.dumps(document))
    elif row is not None:
        print(_active(row))
    elif plan.is_same:
        is_whole = plan.verified is None or plan.verified.is_whole
        doubt = "" if is_whole else f"  NOT VERIFIED: {NOT_ASKED}."
        print(f"The controller holds exactly this: nothing to send.{doubt}")
    elif not plan.objections:
        print("Nothing was sent.")
    for text in plan.objections:
        print(f"rtid: refused: {text}", file=sys.stderr)
    is_short = not plan.is_same if row is None else not row.is_verified
    if is_short and not dry_run:
        raise typer.Exit(Exit.NEGATIVE)


def _applied(row: VersionRow) -> dict[str, Any]:
    """What was done, for `--json`."""
    verified = row.told.get("verified")
    return {"version": row.version, "who": row.who, "outcome": row.outcome, "verified": verified}


def _active(row: VersionRow) -> str:
    """What is active now, how far that was asked, and what nobody can ask."""
    back = "Back with `rtid apply --undo`."
    if not row.is_verified:
        what = f"active, as the controller says: version {row.version}, NOT VERIFIED"
        return f"{what}: {NOT_ASKED}.  {back}"
    verified = row.told["verified"]
    return (
        f"active: version {row.version}; version and CRC of {verified['slots']} slots read back, "
        f"{verified['points']} flows asked and right.  {back}\n"
        "not verified: flows that were not asked, and what the firmware does with them"
    )


def _show(plan: Plan) -> None:
    from rtid.tell.terminal import make_console

    console = make_console()
    review = plan.review
    console.print(plan.why)
    console.print(plan.held_text)
    console.print(_changes(plan))
    console.print(
        "on data: largest change where the old or the new map stands on data, and its share of the "
        "rated flow; valid: share of the plane of u and dp; table: what the look-up table is off by"
    )
    pressure = scale_of("Pa")
    for chamber, old, new in review.beta_pa:
        before = "none" if old is None else pressure.number(old, 1)
        after = f"{pressure.number(new, 1)} {pressure.name}"
        console.print(f"bulk modulus {chamber}: {before} -> {after}")
    if plan.tracking is not None:
        told = plan.tracking
        console.print(told if isinstance(told, str) else told.sentence)
    if not plan.is_same:
        size = sum(len(data) for data in plan.prepared.images.values())
        console.print(f"would be version {review.version}: {size} bytes")


def _changes(plan: Plan) -> Table:
    """What would change, valve by valve."""
    from rtid.tell.story import Table

    flow, pressure = scale_of("m3/s"), scale_of("Pa")
    errors = {sampled.edge: sampled for sampled in plan.prepared.sampled}
    rows = []
    for sampled in plan.review.differences:
        error = errors.get(sampled.edge)
        rows.append((
            sampled.edge,
            _number(flow.factor * sampled.largest_m3s, "+.4g"),
            _number(sampled.u_v, ".2f"),
            _number(pressure.factor * sampled.dp_pa, ".4g"),
            _number(flow.factor * sampled.rms_m3s, ".3g"),
            _number(flow.factor * sampled.believed_m3s, "+.4g"),
            _number(sampled.believed_percent, ".1f"),
            f"{100 * sampled.valid_before:.0f} -> {100 * sampled.valid:.0f}",
            "-" if error is None else f"{100 * error.error_max_m3s / sampled.rated_m3s:.3f}",
        ))  # fmt: skip
    heads = (
        "valve", f"largest {flow.name}|", "at V|", f"{pressure.name}|", "rms|", "on data|",
        "% rated|", "valid %|", "table %|",
    )  # fmt: skip
    return Table("", heads, rows)


def _number(value: float, form: str) -> str:
    return format(value, form) if value == value else "-"  # noqa: PLR0124
