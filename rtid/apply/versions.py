"""What was sent to the controller: the images of each apply as files, and who sent them when.

`applied/v000007` in the state folder holds the images of version 7 (slot-0.img, ...) and the map
that they were made from; the table `applied` of the history says what was made active, in order.
An undo is a row of its own: another version, with the content of an older one.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge.lookup import crc32
from firmware_bridge.protocol import LAST_VERSION
from rtid.apply.judge import KnownMap
from rtid.errors import RtidError
from rtid.estimator.flowmap import FlowMap
from rtid.maps.files import read_map, write_map
from rtid.trace.state_files import read_bytes, write_bytes

FILE, FOLDER, MAP_FILE = "history.sqlite", "applied", "map.npz"
TABLE = """
CREATE TABLE IF NOT EXISTS applied (
    unix_s REAL, version INTEGER, content INTEGER, who TEXT, crcs TEXT, outcome TEXT, told TEXT
);
"""
# UNVERIFIED: the controller says that it holds the maps, and cannot be asked for their flows.
DONE, UNVERIFIED = "done", "not verified"
UNCONFIRMED, CONTRADICTED = "unconfirmed", "contradicted"


class AppliedError(RtidError):
    """The records of what was sent contradict themselves or cannot be read."""


@dataclass(frozen=True)
class VersionRow:
    """One apply: `content` is the version whose files were sent, told what was shown."""

    unix_s: float
    version: int
    content: int
    who: str
    crcs: dict[int, int]
    outcome: str
    told: dict[str, Any]

    @property
    def is_active(self) -> bool:
        """Whether its maps became active, as far as the controller can tell."""
        return self.outcome in (DONE, UNVERIFIED)

    @property
    def is_verified(self) -> bool:
        """Whether these very maps have answered for themselves."""
        return self.outcome == DONE


class Applied:
    """The records in a state folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def rows(self) -> list[VersionRow]:
        """All applies, the oldest first.  AppliedError where they cannot be read."""
        if not (self._folder / FILE).is_file():
            return []
        try:
            with closing(_database(self._folder)) as database, database:
                records = database.execute("SELECT * FROM applied ORDER BY rowid").fetchall()
            return [
                VersionRow(
                    t, v, c, who, _numbered(json.loads(crcs)), outcome, json.loads(provenance)
                )
                for t, v, c, who, crcs, outcome, provenance in records
            ]
        except (sqlite3.Error, ValueError, TypeError) as error:
            raise AppliedError(
                f"{self._folder / FILE}: not a history of rtid, or damaged ({error})",
                "move it away: what was sent before is then no longer known",
            ) from error

    def note(self, row: VersionRow) -> None:
        """Write an apply down; sqlite3.Error where the disk does not take it."""
        self._folder.mkdir(parents=True, exist_ok=True)
        values = (row.unix_s, row.version, row.content, row.who)
        texts = (json.dumps(row.crcs), row.outcome, json.dumps(row.told))
        with closing(_database(self._folder)) as database, database:
            database.execute("INSERT INTO applied VALUES (?, ?, ?, ?, ?, ?, ?)", (*values, *texts))

    def keep(
        self, version: int, images: dict[int, bytes], flow_map: FlowMap, provenance: dict[str, Any]
    ) -> None:
        """Store what is about to be sent as a content of its own: all files or none."""
        final = self._path(version)
        partial = final.with_name(f"part-{final.name}")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        for slot, data in images.items():
            write_bytes(partial / f"slot-{slot}.img", data, sync=True)
        write_map(partial / MAP_FILE, flow_map, provenance)
        shutil.rmtree(final, ignore_errors=True)  # of an apply that was never sent
        os.replace(partial, final)

    def drop(self, version: int) -> None:
        """Forget a content that was not sent."""
        shutil.rmtree(self._path(version), ignore_errors=True)

    def contents(self) -> list[int]:
        """Versions whose files are here."""
        names = (path.name[1:] for path in (self._folder / FOLDER).glob("v*"))
        return sorted(int(name) for name in names if name.isdecimal())

    def images(self, content: int) -> dict[int, bytes]:
        """The images of a content by slot.  AppliedError if they are not here."""
        paths = sorted(self._path(content).glob("slot-*.img"))
        if not paths:
            raise AppliedError(
                f"{self._path(content)}: the images of version {content} are not here",
                "apply a map anew",
            )
        return {int(path.stem.partition("-")[2]): read_bytes(path) for path in paths}

    def with_crcs(self, crcs: dict[int, int]) -> int | None:
        """The newest content whose images have these CRCs."""
        for content in reversed(self.contents()):
            if {slot: crc32(data) for slot, data in self.images(content).items()} == crcs:
                return content
        return None

    def known(self, content: int) -> KnownMap:
        """The map of a content with its bulk modulus."""
        flow_map, provenance = read_map(self._path(content) / MAP_FILE)
        return KnownMap(flow_map, np.asarray(provenance["beta_pa"], float))

    def newest(self) -> VersionRow | None:
        """The last apply, confirmed or not."""
        rows = self.rows()
        return rows[-1] if rows else None

    def before(self, content: int) -> int | None:
        """The content that was active before this one first was."""
        earlier: list[int] = []
        for row in self.rows():
            if row.content == content:
                return earlier[-1] if earlier else None
            if row.is_active:
                earlier.append(row.content)
        return None

    def next_version(self, on_board: int = 0) -> int:
        """Above everything that was ever sent, and above what the controller holds."""
        last = max([on_board, *(row.version for row in self.rows()), *self.contents()])
        if last >= LAST_VERSION:
            where = "the controller holds" if on_board == last else f"{self._folder} knows of"
            raise AppliedError(
                f"{where} version {last}: no map can be newer",
                "take its maps away, with its own tool, and name a new state folder with --state",
            )
        return last + 1

    def _path(self, content: int) -> Path:
        return self._folder / FOLDER / f"v{content:06d}"


def _database(folder: Path) -> sqlite3.Connection:
    database = sqlite3.connect(folder / FILE, timeout=10.0)
    database.execute("PRAGMA journal_mode=WAL")
    database.executescript(TABLE)
    return database


def _numbered(crcs: dict[str, int]) -> dict[int, int]:
    return {int(slot): crc for slot, crc in crcs.items()}
