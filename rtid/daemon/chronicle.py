"""History in SQLite (WAL): estimates, alarms, verdicts and decisions, readable while it grows.

Estimates go after KEPT_S, the others stay: about 3 MB a day at a publication every 10 s.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtid.daemon.acceptance import Acceptance
from rtid.daemon.status import Alarm, Verdict

if TYPE_CHECKING:
    from rtid.daemon.jobs import Publication
    from rtid.model import Edge
    from rtid.plain import FloatArray

FILE = "history.sqlite"
DAY_S = 86_400.0
KEPT_S = 180 * DAY_S
TABLES = """
CREATE TABLE IF NOT EXISTS estimate (unix_s REAL, chamber TEXT, beta_pa REAL, beta_sd_pa REAL);
CREATE TABLE IF NOT EXISTS map (unix_s REAL, edge TEXT, valid INTEGER, visited INTEGER, rho REAL);
CREATE TABLE IF NOT EXISTS alarm (unix_s REAL, name TEXT, kind TEXT, text TEXT, over INTEGER);
CREATE TABLE IF NOT EXISTS verdict (unix_s REAL, verdict TEXT, text TEXT, content TEXT);
CREATE TABLE IF NOT EXISTS decision (unix_s REAL, what TEXT, who TEXT, reason TEXT);
CREATE TABLE IF NOT EXISTS quantity
  (unix_s REAL, name TEXT, unit TEXT, value REAL, sd REAL);
CREATE INDEX IF NOT EXISTS quantity_time ON quantity (unix_s);
CREATE INDEX IF NOT EXISTS estimate_time ON estimate (unix_s);
CREATE INDEX IF NOT EXISTS map_time ON map (unix_s);
"""
QUANTITY = "INSERT INTO quantity VALUES (?, ?, ?, ?, ?)"


class Chronicle:
    """One row per event; sqlite3.Error where the disk does not take it."""

    def __init__(self, folder: Path) -> None:
        self._database = sqlite3.connect(folder / FILE, isolation_level=None)
        self._database.execute("PRAGMA journal_mode=WAL")
        self._database.execute("PRAGMA synchronous=NORMAL")
        self._database.executescript(TABLES)
        self._pruned_s = 0.0
        self._on_board = frozenset[str]()  # names of the sizes that are learned all the time

    def note_publication(self, publication: Publication, chambers: list[str]) -> None:
        """One row per chamber, per edge and per size of an added effect."""
        now_s = time.time()
        self._on_board = frozenset(effect.name for effect in publication.effects)
        sizes = [(now_s, e.name, e.unit, e.size, e.sd) for e in publication.effects]
        estimates = [
            (now_s, name, float(beta), float(sd))
            for name, beta, sd in zip(
                chambers, publication.beta_pa, publication.beta_sd_pa, strict=True
            )
        ]
        maps = [
            (now_s, e.name, e.blocks.get("valid", 0), sum(e.blocks.values()), publication.rho)
            for e in publication.edges
        ]
        self._database.execute("BEGIN")
        self._database.executemany("INSERT INTO estimate VALUES (?, ?, ?, ?)", estimates)
        self._database.executemany("INSERT INTO map VALUES (?, ?, ?, ?, ?)", maps)
        self._database.executemany(QUANTITY, sizes)
        self._database.execute("COMMIT")
        if now_s - self._pruned_s > DAY_S:
            self._pruned_s = now_s
            for table in ("estimate", "map", "quantity"):
                self._database.execute(f"DELETE FROM {table} WHERE unix_s < ?", (now_s - KEPT_S,))

    def note_alarm(self, alarm: Alarm) -> None:
        """One row when it begins and one when it is over."""
        over = alarm.until_unix_s is not None
        when_s = alarm.until_unix_s if alarm.until_unix_s is not None else alarm.since_unix_s
        row = (when_s, alarm.name, alarm.kind, alarm.text, over)
        self._database.execute("INSERT INTO alarm VALUES (?, ?, ?, ?, ?)", row)

    def note_verdict(self, verdict: Verdict) -> None:
        """One row per diagnosis, one per number that it has learned and nobody learns on board."""
        row = (verdict.at_unix_s, verdict.verdict, verdict.text, json.dumps(verdict.content))
        self._database.execute("INSERT INTO verdict VALUES (?, ?, ?, ?)", row)
        rows = [
            (verdict.at_unix_s, *number)
            for number in learned(verdict.content)
            if number[0] not in self._on_board
        ]
        self._database.executemany(QUANTITY, rows)

    def note_wear(self, edges: Sequence[Edge], worn: FloatArray) -> None:
        """One row per map: the change of its gain since it was first learned.

        worn (edges,), relative, dimensionless.
        """
        pairs, now_s = zip(edges, worn.tolist(), strict=True), time.time()
        rows = [(now_s, f"wear of {e.name}", "", g, 0.0) for e, g in pairs if not e.shares]
        self._database.executemany(QUANTITY, rows)

    def note_acceptance(self, acceptance: Acceptance) -> None:
        """One row: somebody has taken the changed machine for the new normal."""
        row = (
            acceptance.at_unix_s,
            "accepted the changed machine",
            acceptance.who,
            acceptance.reason,
        )
        self._database.execute("INSERT INTO decision VALUES (?, ?, ?, ?)", row)

    def close(self) -> None:
        """Write everything back."""
        self._database.close()


def learned(content: Mapping[str, Any]) -> Iterator[tuple[str, str, float, float]]:
    """Name, unit, value and standard deviation, SI, of what a diagnosis has learned.

    content: JSON of rtid/diagnose/schema.md.
    """
    if content.get("lag_s") is not None and content.get("lag_sd_s"):
        yield "spool lag", "s", content["lag_s"], content["lag_sd_s"]
    for effect in (*content.get("added", ()), *content.get("found", ())):
        key = f"{effect['effect']} {effect['where']}"
        for k, (name, number) in enumerate(effect["parameters"].items()):
            if number["value"] is not None and number["std"]:
                yield f"{key} {name}" if k else key, number["unit"], number["value"], number["std"]
