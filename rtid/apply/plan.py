"""Sends a learned map to the controller: differences, download, read back, records.

`prepare` makes the images of a map, `review` tells what would change at what the controller holds;
what speaks against it is in `rtid.apply.bounds`.  Only `send` changes anything.  Nothing here opens
a bus: the caller brings a session on an armed link (`rtid.apply.reach`).
"""

from __future__ import annotations

import getpass
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from firmware_bridge.download import (
    ContradictedError,
    Image,
    Progress,
    Session,
    UnconfirmedError,
    download,
)
from firmware_bridge.lookup import Table, crc32, image, numbers_image, numbers_of, table_of
from firmware_bridge.protocol import Accepts, Held
from firmware_bridge.verify import Verified, verify
from rtid.apply.difference import Difference, difference
from rtid.apply.judge import KnownMap
from rtid.apply.versions import CONTRADICTED, DONE, UNCONFIRMED, UNVERIFIED, Applied, VersionRow
from rtid.errors import RtidError
from rtid.maps.lookup import Sampled, on_wire, sample
from rtid.plain import FloatArray
from rtid.project import Project


class ApplyError(RtidError):
    """A map that must not or cannot be sent; the text says why."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """Images by slot; sampled: how closely each table follows its map, none where stored ones go.

    known: the map that they were made from; content: the version whose files these are, None for
    something new.
    """

    images: dict[int, bytes]
    known: KnownMap
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
            "edges": [beta.as_json() for beta in self.differences],
            "beta_pa": [list(beta) for beta in self.beta_pa],
        }


def slots(project: Project) -> list[int]:
    """The slots of the edges, then that of the bulk moduli."""
    first = project.sections.publish.first_slot
    return [first + k for k in range(len(project.model.maps) + 1)]


def edge_tables(project: Project, images: Mapping[int, bytes]) -> dict[str, Table]:
    """The tables of all edges, by name, of images by slot."""
    pairs = zip(project.model.edges, slots(project), strict=False)
    return {edge.name: table_of(images[slot]) for edge, slot in pairs}


def refuse_few_slots(project: Project, room: Accepts) -> None:
    """ApplyError where the controller has not a slot for everything."""
    of = slots(project)
    if max(of) >= room.slots:
        raise ApplyError(
            f"{project.path}: needs slots {of[0]} to {of[-1]}, the controller has {room.slots}",
            "correct publish.first_slot, or give the firmware more slots",
            2,
        )


def prepare(project: Project, known: KnownMap, sd_pa: FloatArray, room: Accepts) -> Prepared:
    """The images of a map, as closely as the project asks for and the controller has room.

    sd_pa (chambers,): standard deviations of the bulk moduli, Pa.
    """
    of = slots(project)

    def fits(nu: int, ns: int) -> bool:
        return on_wire(nu, ns) and nu + ns <= room.nodes and nu * ns <= room.counts

    percent = project.sections.publish.error_percent
    sampled = tuple(
        sample(edge, known.flow_map[edge.name], percent, fits) for edge in project.model.maps
    )
    images = {
        slot: image(sampled.table, slot) for slot, sampled in zip(of[:-1], sampled, strict=True)
    }
    numbers = np.column_stack([known.beta_pa, sd_pa])
    images[of[-1]] = numbers_image(np.where(np.isfinite(numbers), numbers, 0.0), of[-1])
    return Prepared(images, known, sampled)


def stored(applied: Applied, content: int) -> Prepared:
    """What was sent before, byte for byte."""
    return Prepared(applied.images(content), applied.known(content), content=content)


def review(
    project: Project, applied: Applied, on_board: Mapping[int, Held], prepared: Prepared
) -> Review:
    """What would change; on_board: by slot, as the controller says."""
    crcs = {slot: slot_state.crc for slot, slot_state in on_board.items()}
    holds = any(slot_state.version for slot_state in on_board.values())
    content = applied.with_crcs(crcs) if holds else None
    before = applied.images(content) if content is not None else {}
    *of_edges, of_beta = slots(project)
    differences = tuple(
        difference(edge, _table(before, slot), table_of(prepared.images[slot]))
        for edge, slot in zip(project.model.maps, of_edges, strict=True)
    )
    old = numbers_of(before[of_beta])[::2] if of_beta in before else None
    new = numbers_of(prepared.images[of_beta])[::2]
    beta = tuple(
        (chamber.name, None if old is None else float(old[k]), float(new[k]))
        for k, chamber in enumerate(project.model.chambers)
    )
    newest = max(slot_state.version for slot_state in on_board.values())
    is_same = crcs == {slot: crc32(data) for slot, data in prepared.images.items()}
    version = applied.next_version(newest)
    return Review(newest, content, holds, version, differences, beta, is_same)


def _table(images: Mapping[int, bytes], slot: int) -> Table | None:
    return table_of(images[slot]) if slot in images else None


def send(
    session: Session,
    applied: Applied,
    prepared: Prepared,
    reviewed: Review,
    provenance: Mapping[str, Any],
    progress: Progress = lambda done, total: None,
    now_s: Callable[[], float] = time.time,
) -> VersionRow:
    """Download, make active, ask what is active, write down.

    Raises DownloadError: then the controller is as before.  An order that was not confirmed, or
    that what the controller holds contradicts, is written down as such, and raised.
    """
    content = prepared.content or reviewed.version
    if prepared.content is None:
        provenance_of = dict(provenance) | {"beta_pa": prepared.known.beta_pa.tolist()}
        applied.keep(content, prepared.images, prepared.known.flow_map, provenance_of)
    crcs = {slot: crc32(data) for slot, data in prepared.images.items()}
    shown = reviewed.as_json() | {"provenance": dict(provenance)}

    def noted(outcome: str, **more: Any) -> VersionRow:
        row = VersionRow(now_s(), reviewed.version, content, _who(), crcs, outcome, shown | more)
        applied.note(row)
        return row

    images = {slot: Image(data) for slot, data in prepared.images.items()}
    try:
        download(session, images, reviewed.version, progress)
    except UnconfirmedError:
        noted(UNCONFIRMED)
        raise
    except Exception:
        if prepared.content is None:
            applied.drop(content)
        raise
    try:
        verified = checked(session, applied, prepared, reviewed)
    except ContradictedError:
        noted(CONTRADICTED)
        raise
    except Exception:
        noted(UNCONFIRMED)
        raise
    return noted(DONE if verified.is_whole else UNVERIFIED, verified=asdict(verified))


def checked(session: Session, applied: Applied, prepared: Prepared, result: Review) -> Verified:
    """Whether the prepared images are active.  Raises ContradictedError where they are not."""
    known = result.held_content is not None and not result.is_same
    before = applied.images(result.held_content) if known and result.held_content else {}
    version = None if result.is_same else result.version
    return verify(session, prepared.images, version, before)


def _who() -> str:
    return f"{getpass.getuser()}@{socket.gethostname()}"
