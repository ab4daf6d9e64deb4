"""Sends a learned map to the controller: differences, limits, download, records.

`prepare` makes the images of a map, `review` asks the controller what it holds and tells what would
change and what speaks against it; only `send` changes anything.  Nothing here opens a bus: the
caller brings a session on an armed link (`rtid.reach`).
"""

from __future__ import annotations

import getpass
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_bridge.download import Image, Progress, Session, UnconfirmedError, download
from firmware_bridge.lookup import Table, crc32, image, numbers_image, numbers_of, table_of
from firmware_bridge.protocol import Accepts, Held
from rtid.applied import DONE, UNCONFIRMED, Applied, Row
from rtid.difference import Difference, difference
from rtid.errors import RtidError
from rtid.judging import Known
from rtid.lookup import Sampled, on_wire, sample
from rtid.model import FloatArray
from rtid.project import Project

LPM = 6e4  # L/min in a m3/s


class ApplyError(RtidError):
    """A map that must not or cannot be sent; the text says why."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """Images by slot; sampled: how closely each table follows its map, none where stored ones go.

    known: the map that they were made from; content: the version whose files these are, None for
    something new.
    """

    images: dict[int, bytes]
    known: Known
    sampled: tuple[Sampled, ...] = ()
    content: int | None = None


@dataclass(frozen=True, eq=False)
class Review:
    """What the controller holds, and what would change."""

    held_version: int
    held_content: int | None  # None: nothing, or something that this folder does not know
    holds: bool
    version: int  # that would be sent
    differences: tuple[Difference, ...]
    beta_pa: tuple[tuple[str, float | None, float], ...]  # chamber, held, new
    is_same: bool

    @property
    def is_unknown(self) -> bool:
        """Whether it holds maps that were not sent from here."""
        return self.holds and self.held_content is None

    def as_json(self) -> dict[str, Any]:
        """What is shown, and written down."""
        return {
            "held_version": self.held_version,
            "version": self.version,
            "edges": [one.as_json() for one in self.differences],
            "beta_pa": [list(one) for one in self.beta_pa],
        }


def slots(project: Project) -> list[int]:
    """The slots of the edges, then that of the bulk moduli."""
    first = project.sections.publish.first_slot
    return [first + k for k in range(len(project.model.edges) + 1)]


def prepare(project: Project, known: Known, sd_pa: FloatArray, room: Accepts) -> Prepared:
    """The images of a map, as closely as the project asks for and the controller has room."""
    of = slots(project)
    if max(of) >= room.slots:
        raise ApplyError(
            f"{project.path}: needs slots {of[0]} to {of[-1]}, the controller has {room.slots}",
            "correct publish.first_slot, or give the firmware more slots",
            2,
        )

    def fits(nu: int, ns: int) -> bool:
        return on_wire(nu, ns) and nu + ns <= room.nodes and nu * ns <= room.counts

    percent = project.sections.publish.error_percent
    sampled = tuple(
        sample(edge, known.flow_map[edge.name], percent, fits) for edge in project.model.edges
    )
    images = {slot: image(one.table, slot) for slot, one in zip(of[:-1], sampled, strict=True)}
    numbers = np.column_stack([known.beta_pa, sd_pa])
    images[of[-1]] = numbers_image(np.where(np.isfinite(numbers), numbers, 0.0), of[-1])
    return Prepared(images, known, sampled)


def stored(applied: Applied, content: int) -> Prepared:
    """What was sent before, byte for byte."""
    return Prepared(applied.images(content), applied.known(content), content=content)


def review(
    project: Project, applied: Applied, held: Mapping[int, Held], prepared: Prepared
) -> Review:
    """What would change; held: by slot, as the controller says."""
    crcs = {slot: one.crc for slot, one in held.items()}
    holds = any(one.version for one in held.values())
    content = applied.with_crcs(crcs) if holds else None
    before = applied.images(content) if content is not None else {}
    *of_edges, of_beta = slots(project)
    differences = tuple(
        difference(edge, _table(before, slot), table_of(prepared.images[slot]))
        for edge, slot in zip(project.model.edges, of_edges, strict=True)
    )
    old = numbers_of(before[of_beta])[::2] if of_beta in before else None
    new = numbers_of(prepared.images[of_beta])[::2]
    beta = tuple(
        (chamber.name, None if old is None else float(old[k]), float(new[k]))
        for k, chamber in enumerate(project.model.chambers)
    )
    newest = max(one.version for one in held.values())
    is_same = crcs == {slot: crc32(data) for slot, data in prepared.images.items()}
    version = applied.next_version(newest)
    return Review(newest, content, holds, version, differences, beta, is_same)


def _table(images: Mapping[int, bytes], slot: int) -> Table | None:
    return table_of(images[slot]) if slot in images else None


def objections(project: Project, applied: Applied, found: Review) -> list[str]:
    """What the limits of the project have against it; empty if nothing."""
    section, said = project.sections.publish, []
    for one in found.differences:
        if one.believed_percent > section.max_change_percent:
            said.append(
                f"{one.edge}: the flow changes by {LPM * one.believed_m3s:+.2f} L/min "
                f"({one.believed_percent:.1f} % of the rated flow) at {one.believed_u_v:.2f} V, "
                f"dp = {1e-6 * one.believed_dp_pa:.2f} MPa; publish.max_change_percent is "
                f"{section.max_change_percent:g}: raise it for this apply if the change is right"
            )
    last = applied.newest()
    since_s = time.time() - last.unix_s if last is not None else np.inf
    if since_s < section.least_interval_s:
        said.append(
            f"the last apply was {max(since_s, 0.0):.0f} s ago; publish.least_interval_s is "
            f"{section.least_interval_s:g}"
        )
    return said


def send(
    session: Session,
    applied: Applied,
    prepared: Prepared,
    found: Review,
    provenance: Mapping[str, Any],
    progress: Progress = lambda done, total: None,
    now_s: Callable[[], float] = time.time,
) -> Row:
    """Download, make active, write down.  Raises DownloadError: then the controller is as before.

    An order that was not confirmed is written down as such, and raised.
    """
    content = prepared.content or found.version
    if prepared.content is None:
        told = dict(provenance) | {"beta_pa": prepared.known.beta_pa.tolist()}
        applied.keep(content, prepared.images, prepared.known.flow_map, told)
    crcs = {slot: crc32(data) for slot, data in prepared.images.items()}
    shown = found.as_json() | {"provenance": dict(provenance)}

    def noted(outcome: str) -> Row:
        row = Row(now_s(), found.version, content, _who(), crcs, outcome, shown)
        applied.note(row)
        return row

    images = {slot: Image(data) for slot, data in prepared.images.items()}
    try:
        download(session, images, found.version, progress)
    except UnconfirmedError:
        noted(UNCONFIRMED)
        raise
    except Exception:
        if prepared.content is None:
            applied.drop(content)
        raise
    return noted(DONE)


def _who() -> str:
    return f"{getpass.getuser()}@{socket.gethostname()}"
