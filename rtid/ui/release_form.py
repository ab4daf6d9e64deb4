"""The release of maps from the page: which tables, how they differ, files to take and to sign.

What `rtid export` does, with its --tolerance, --nodes, --bytes, --axes, --flashed and --sheet.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from rtid.errors import RtidError
from rtid.tell.html import button, select, table, text

if TYPE_CHECKING:
    from rtid.estimator.flowmap import FlowMap
    from rtid.maps.flashed import FlashedMap
    from rtid.maps.release import Room
    from rtid.study.study import Study

PLACE = "/release"
FLASHED = (".dcm", ".cdfx", ".csv")
MOST_FILES = 12  # of the folder that are offered as what is flashed
NOTHING = "nothing"
ROOMS = {  # words, and the example that stands in the field
    "tolerance": ("off by at most, %", "0.2"),
    "nodes": ("nodes at most", "16x12"),
    "bytes": ("bytes at most", "8192"),
    "axes": ("the axes of what is flashed", ""),
}


@dataclass(frozen=True)
class ReleaseWish:
    """What is asked for, as chosen and typed; flashed: a file of the record's folder, or none."""

    suffix: str = ".dcm"
    room: str = "tolerance"
    amount: str = ""
    flashed: str = NOTHING


@dataclass(frozen=True)
class Released:
    """Files that were written, the sheet to be signed the last; rows as `rtid.tell.released`."""

    files: tuple[Path, ...]
    rows: tuple[tuple[str, ...], ...]
    changed: tuple[tuple[str, ...], ...]


def release(study: Study, flowmap: FlowMap, wish: ReleaseWish) -> Released:
    """Write the maps of a revision beside its record.  Raises RtidError where they do not fit."""
    from rtid.estimator.validity import doubts_of  # noqa: PLC0415 - the live page needs none
    from rtid.maps.files import provenance  # noqa: PLC0415
    from rtid.maps.flashed import differences, read_flashed  # noqa: PLC0415
    from rtid.maps.release import refuse_unfounded, write_release  # noqa: PLC0415
    from rtid.study.known_effects import as_json  # noqa: PLC0415
    from rtid.tell.released import changed_rows, rows, sheet  # noqa: PLC0415

    project, trace, fit = study.project, study.path, study.fit
    path = trace.with_suffix(f".map{wish.suffix}")
    invalid = [d for d in doubts_of(fit.solution, fit.lag_s, fit.lag_sd_s) if d.is_invalid]
    refuse_unfounded(trace.name, wish.suffix, invalid, flowmap)
    there = () if wish.flashed == NOTHING else read_flashed(trace.parent / Path(wish.flashed).name)
    changes = differences(flowmap, there) if there else []
    origin = provenance(
        fit.solution, project.name, project.digest, trace.name, as_json(study.effects)
    )
    before = _stamps(path)
    tables = write_release(path, flowmap, origin, room_of(wish, there))
    page = path.with_suffix(".sheet.html")
    page.write_text(sheet(path.name, tables, changes, origin), "utf-8")
    files = [p for p, stamp in _stamps(path).items() if before.get(p) != stamp and p != page]
    return Released((*sorted(files), page), tuple(rows(tables)), tuple(changed_rows(changes)))


def _stamps(path: Path) -> dict[Path, int]:
    """The files that a release may have written, and when they were."""
    beside = path.parent.glob(f"{path.name.split('.')[0]}*")
    return {p: p.stat().st_mtime_ns for p in beside if p.is_file()}


def room_of(wish: ReleaseWish, there: tuple[FlashedMap, ...]) -> Room:
    """What was typed as the room of the tables; nothing typed: what `rtid export` takes."""
    from rtid.maps.release import Room  # noqa: PLC0415 - the live page needs none

    typed = wish.amount.strip().replace(",", ".").replace(" ", "")
    if wish.room == "axes":
        if not there:
            raise RtidError("axes of what is flashed: nothing is chosen there", "choose a file")
        return Room(axes=there)
    with suppress(ValueError):
        if not typed:
            return Room()
        if wish.room == "nodes" and (pair := re.fullmatch(r"(\d+)[x*](\d+)", typed)):
            return Room(nodes=(int(pair[1]), int(pair[2])))
        if wish.room == "bytes" and int(typed) > 0:
            return Room(n_bytes=int(typed))
        if wish.room == "tolerance" and 0.01 <= float(typed) <= 50.0:
            return Room(share=0.01 * float(typed))
    words, example = ROOMS.get(wish.room, ("room", ""))
    raise RtidError(f"{words}: {wish.amount!r} cannot be that", f"as {example or 'offered'}")


def controls(wish: ReleaseWish, suffixes: Sequence[str], flashed: Sequence[str]) -> str:
    """Fields and button of a release."""
    words, example = ROOMS.get(wish.room, ROOMS["tolerance"])
    field = (
        f'<label>{text(words)} <input id="amount" data-do="amount" size="7" '
        f'value="{text(wish.amount)}" placeholder="{example}"></label>'
    )
    return (
        select("suffix", {s: s[1:] for s in suffixes}, wish.suffix, "release as")
        + select("room", {k: w for k, (w, _) in ROOMS.items()}, wish.room, "as large as")
        + ("" if wish.room == "axes" else field)
        + select("flashed", [NOTHING, *flashed], wish.flashed, "flashed is")
        + button("Release", "release", kind="main", amount=wish.amount)
    )


def shown(released: Released) -> str:
    """What was written, to be taken; its tables, and how they differ from what is flashed."""
    from rtid.tell.released import CHANGED, HEADS  # noqa: PLC0415 - the live page needs none

    links = "".join(
        f'<a class="chip" href="{PLACE[1:]}?name={quote(p.name)}" download>{text(p.name)}</a>'
        for p in released.files
    )
    parts = [f"<br>Take it, and the sheet to be signed: {links}"]
    for heads, rows in ((HEADS, released.rows), (CHANGED, released.changed)):
        if rows:
            parts.append(table(heads, [[text(cell) for cell in row] for row in rows], "figures"))
    return "".join(parts)
