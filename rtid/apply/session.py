"""One `rtid apply` from the wish to the record: what the command does, as one call."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from firmware_bridge.download import Progress, Session
from firmware_bridge.lookup import numbers_of
from firmware_bridge.protocol import Accepts, Held
from firmware_bridge.verify import Verified, verify
from rtid.apply import offer as offered
from rtid.apply import reach
from rtid.apply.bounds import objections
from rtid.apply.plan import (
    ApplyError,
    Prepared,
    Review,
    checked,
    edge_tables,
    prepare,
    refuse_few_slots,
    review,
    send,
    slots,
    stored,
)
from rtid.apply.tracking import TrackingForecast, told
from rtid.apply.versions import DONE, UNCONFIRMED, UNVERIFIED, Applied, VersionRow
from rtid.apply.wish import Wish, chunk_of, wished
from rtid.project import Project, load
from rtid.project.folder import state_folder
from rtid.trace.state_files import locked

ANY_ROOM = Accepts(1, 16, 2 * 255, 0xFFFF)
LOCK = "apply.lock"


@dataclass(frozen=True, eq=False)
class Plan:
    """What would be sent, why, and what speaks against it.

    verified: of a map that the controller holds already, how far that could be asked.
    tracking: what the map will do to it, where the project describes its controller, and why that
    cannot be told.
    """

    prepared: Prepared
    review: Review
    why: str
    objections: tuple[str, ...]
    provenance: dict[str, Any]
    verified: Verified | None = None
    tracking: TrackingForecast | str | None = None

    @property
    def is_same(self) -> bool:
        """Whether the controller holds exactly this."""
        return self.review.is_same

    @property
    def held_text(self) -> str:
        """What the controller holds, in words."""
        reviewed = self.review
        if not reviewed.holds:
            return "The controller holds no map."
        if reviewed.held_content is None:
            return f"The controller holds version {reviewed.held_version}, which is not from here."
        is_own = reviewed.held_content == reviewed.held_version
        again = "" if is_own else f" (as {reviewed.held_content})"
        return f"The controller holds version {reviewed.held_version}{again}."

    def as_json(self) -> dict[str, Any]:
        """For `--json`."""
        lookup = {
            sampled.edge: {
                "nodes": list(sampled.table.counts.shape),
                "error_max_m3s": sampled.error_max_m3s,
                "error_rms_m3s": sampled.error_rms_m3s,
                "error_at": {"u_v": sampled.error_u_v, "dp_pa": sampled.error_dp_pa},
            }
            for sampled in self.prepared.sampled
        }
        document = {"schema": 1, "why": self.why, "objections": list(self.objections)}
        tracked = self.tracking
        document["tracking"] = (
            tracked.as_json() if isinstance(tracked, TrackingForecast) else tracked
        )
        return document | self.review.as_json() | {"lookup": lookup, "is_same": self.is_same}


def apply_map(
    path: Path,
    wish: Wish,
    confirmed: Callable[[Plan], bool],
    progress: Progress = lambda done, total: None,
) -> tuple[Plan, VersionRow | None]:
    """Do it, if `confirmed` says so after it has seen the plan; the row that was written, or None.

    progress hears how many of the chunks have arrived.  Raises ApplyError, NoOfferError,
    DownloadError, SendError, and the errors of what is read.
    """
    project = load(path)
    reach.check(project)
    folder = wish.state or state_folder(project)
    applied = Applied(folder)
    folder.mkdir(parents=True, exist_ok=True)
    under_way = ApplyError(f"{folder}: another apply is under way", "wait for its end")
    with locked(folder / LOCK, under_way):
        if wish.dry_run:
            plan = _plan(
                project, folder, wish, applied, _by_the_records(project, applied), ANY_ROOM
            )
            plan = replace(plan, tracking=_tracking(project, wish, applied, plan))
            confirmed(plan)
            return plan, None
        interface, channel = reach.bus_of(project, wish.bus)
        if interface in reach.TEST_BUSES and not wish.test_bus:
            raise ApplyError(
                f"{interface}: anybody may write to it", "add --test-bus if you want that", 2
            )
        bus = interface, channel
        return _over_the_bus(project, folder, wish, applied, confirmed, bus, progress)


def _tracking(
    project: Project, wish: Wish, applied: Applied, plan: Plan
) -> TrackingForecast | str | None:
    """What the map will do to tracking, or why that is not told; None where nobody asks."""
    section = project.sections.controller
    if section is None:
        return None
    if wish.against is None:
        return "--against TRACE, a record of the usual work, tells what it will do to tracking"
    content = plan.review.held_content
    held = None if content is None else edge_tables(project, applied.images(content))
    prepared = plan.prepared
    sd_pa = numbers_of(prepared.images[slots(project)[-1]])[1::2]
    new = edge_tables(project, prepared.images)
    chunk = chunk_of(project, wish.against)
    return told(project, section, chunk, prepared.known, sd_pa, new, held)


def _over_the_bus(
    project: Project,
    folder: Path,
    wish: Wish,
    applied: Applied,
    confirmed: Callable[[Plan], bool],
    bus: tuple[str, str],
    progress: Progress,
) -> tuple[Plan, VersionRow | None]:
    can_id = project.sections.publish.can_id
    assert can_id is not None, "checked"
    with reach.armed(project, *bus, can_id, folder) as link:
        session = Session(link)
        with _opened(session) as room:
            refuse_few_slots(project, room)
            on_board = {slot: session.held(slot) for slot in slots(project)}
            _settle(folder, applied, on_board, session)
            plan = _plan(project, folder, wish, applied, on_board, room)
            if plan.is_same:
                plan = replace(plan, verified=checked(session, applied, plan.prepared, plan.review))
            if not confirmed(plan) or plan.objections or plan.is_same:
                return plan, None
            session.open()  # that took its time: somebody else may have come
            if {slot: session.held(slot) for slot in on_board} != on_board:
                raise ApplyError("the controller has got other maps meanwhile", "look again")
            row = send(session, applied, plan.prepared, plan.review, plan.provenance, progress)
    offered.withdraw(folder)
    return plan, row


@contextmanager
def _opened(session: Session) -> Iterator[Accepts]:
    room = session.open()
    try:
        yield room
    finally:
        session.close()


def _plan(
    project: Project,
    folder: Path,
    wish: Wish,
    applied: Applied,
    on_board: Mapping[int, Held],
    room: Accepts,
) -> Plan:
    content = _content(applied, on_board)
    if wish.undo:
        prepared, why, provenance = _undone(applied, content)
    elif wish.again:
        prepared, why, provenance = _repeated(applied)
    else:
        known, sd_pa, why, provenance = wished(project, folder, wish, applied, content)
        prepared = prepare(project, known, sd_pa, room)
    reviewed = review(project, applied, on_board, prepared)
    is_free = wish.undo or (wish.again and not reviewed.holds)  # the way back is never barred
    against = () if is_free else tuple(objections(project, applied, reviewed, prepared))
    if reviewed.is_unknown and not wish.replace_unknown:
        text = (
            "the controller holds maps that were not sent from here: what would change is unknown"
        )
        against = (f"{text}; --replace-unknown sends all the same", *against)
    return Plan(prepared, reviewed, why, against, provenance)


def _settle(folder: Path, applied: Applied, on_board: Mapping[int, Held], session: Session) -> None:
    """Write down that an order which was not confirmed has been followed."""
    last = applied.newest()
    if last is None or last.outcome != UNCONFIRMED:
        return
    if {slot: Held(last.version, crc) for slot, crc in last.crcs.items()} == dict(on_board):
        verified = verify(session, applied.images(last.content), last.version, {})
        outcome = DONE if verified.is_whole else UNVERIFIED
        applied.note(replace(last, outcome=outcome, unix_s=time.time()))
        offered.withdraw(folder)


def _content(applied: Applied, on_board: Mapping[int, Held]) -> int | None:
    if not any(tested.version for tested in on_board.values()):
        return None
    return applied.with_crcs({slot: tested.crc for slot, tested in on_board.items()})


def _by_the_records(project: Project, applied: Applied) -> dict[int, Held]:
    """What the controller should hold."""
    last = applied.newest()
    if last is None:
        return dict.fromkeys(slots(project), Held(0, 0))
    return {slot: Held(last.version, crc) for slot, crc in last.crcs.items()}


def _repeated(applied: Applied) -> tuple[Prepared, str, dict[str, Any]]:
    """What was last made active, for a controller that was switched off."""
    done = [row for row in applied.rows() if row.is_active]
    if not done:
        raise ApplyError("nothing was ever sent from here", "`rtid apply` sends a map", 4)
    content = done[-1].content
    return stored(applied, content), f"Once more: the map of version {content}.", {"again": content}


def _undone(applied: Applied, content: int | None) -> tuple[Prepared, str, dict[str, Any]]:
    before = applied.before(content) if content is not None else None
    if content is None or before is None:
        raise ApplyError(
            "nothing to go back to: the controller holds the first map that was sent, or none of "
            "those that were",
            "`rtid apply` sends another one",
            4,
        )
    why = f"Undo: the map of version {before} in place of that of version {content}."
    return stored(applied, before), why, {"undo_of": content}
