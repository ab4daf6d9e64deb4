"""What is said of a map on its way to the controller: what would change, and what is active."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime

from rtid.apply.session import Plan
from rtid.apply.versions import VersionRow
from rtid.tell.story import Story, StoryPart, Table
from rtid.units import scale_of, with_unit

NOT_ASKED = (
    "its receiver is older than the question for a flow: compile firmware_bridge/c anew to be sure"
)
LEGEND = (
    "on data: largest change where the old or the new map stands on data, and its share of the "
    "rated flow; valid: share of the plane of u and dp; table: what the look-up table is off by"
)


def story(plan: Plan) -> Story:
    """Why, what the controller holds, and what would change."""
    return Story(plan.why, (plan.held_text, _changes(plan), LEGEND, *_consequences(plan)))


def _consequences(plan: Plan) -> Iterator[StoryPart]:
    """Bulk moduli, foretold tracking, version and size."""
    pressure, review = scale_of("Pa"), plan.review
    for chamber, old, new in review.beta_pa:
        before = "none" if old is None else pressure.number(old, 1)
        after = f"{pressure.number(new, 1)} {pressure.name}"
        yield f"bulk modulus {chamber}: {before} -> {after}"
    if plan.tracking is not None:
        yield plan.tracking if isinstance(plan.tracking, str) else plan.tracking.sentence
    if not plan.is_same:
        size = sum(len(data) for data in plan.prepared.images.values())
        yield f"would be version {review.version}: {size} bytes"


def _changes(plan: Plan) -> Table:
    """What would change, valve by valve."""
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


def ending(plan: Plan, row: VersionRow | None) -> str:
    """What came of it; "" where objections say it.  row: what was sent."""
    if row is not None:
        return active(row)
    if plan.is_same:
        is_whole = plan.verified is None or plan.verified.is_whole
        doubt = "" if is_whole else f"  NOT VERIFIED: {NOT_ASKED}."
        return f"The controller holds exactly this: nothing to send.{doubt}"
    return "" if plan.objections else "Nothing was sent."


def active(row: VersionRow) -> str:
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


def logged(row: VersionRow) -> str:
    """One apply of the log."""
    when = datetime.fromtimestamp(row.unix_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    changes = [abs(e["largest_m3s"]) for e in row.told.get("edges", ()) if e["largest_m3s"]]
    largest = f"largest change {with_unit(max(changes), 'm3/s')}" if changes else "the first"
    again = "" if row.content == row.version else f", the maps of version {row.content}"
    return f"{when}  version {row.version}{again}: {row.outcome}, by {row.who}, {largest}"
