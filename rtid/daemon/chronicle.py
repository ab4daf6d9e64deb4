"""History in SQLite (WAL): estimates, alarms, verdicts and decisions, readable while it grows.

Estimates go after KEPT_S, the others stay: about 3 MB a day at a publication every 10 s.
"""

from __future__ import annotations

import json
import sqlite3
import time
from pathlib import Path

from rtid.daemon.acceptance import Acceptance
from rtid.daemon.jobs import Publication
from rtid.daemon.status import Alarm, Verdict

FILE = "history.sqlite"
DAY_S = 86_400.0
KEPT_S = 180 * DAY_S
TABLES = """
CREATE TABLE IF NOT EXISTS estimate (unix_s REAL, chamber TEXT, beta_pa REAL, beta_sd_pa REAL);
CREATE TABLE IF NOT EXISTS map (unix_s REAL, edge TEXT, valid INTEGER, visited INTEGER, rho REAL);
CREATE TABLE IF NOT EXISTS alarm (unix_s REAL, name TEXT, kind TEXT, text TEXT, over INTEGER);
CREATE TABLE IF NOT EXISTS verdict (unix_s REAL, verdict TEXT, text TEXT, content TEXT);
CREATE TABLE IF NOT EXISTS decision (unix_s REAL, what TEXT, who TEXT, reason TEXT);
CREATE INDEX IF NOT EXISTS estimate_time ON estimate (unix_s);
CREATE INDEX IF NOT EXISTS map_time ON map (unix_s);
"""


class Chronicle:
    """One row per event; sqlite3.Error where the disk does not take it."""

    def __init__(self, folder: Path) -> None:
        self._database = sqlite3.connect(folder / FILE, isolation_level=None)
        self._database.execute("PRAGMA journal_mode=WAL")
        self._database.execute("PRAGMA synchronous=NORMAL")
        self._database.executescript(TABLES)
        self._pruned_s = 0.0

    def note_publication(self, publication: Publication, chambers: list[str]) -> None:
        """One row per chamber and per edge."""
        now_s = time.time()
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
        self._database.execute("COMMIT")
        if now_s - self._pruned_s > DAY_S:
            self._pruned_s = now_s
            for table in ("estimate", "map"):
                self._database.execute(f"DELETE FROM {table} WHERE unix_s < ?", (now_s - KEPT_S,))

    def note_alarm(self, alarm: Alarm) -> None:
        """One row when it begins and one when it is over."""
        over = alarm.until_unix_s is not None
        when_s = alarm.until_unix_s if alarm.until_unix_s is not None else alarm.since_unix_s
        row = (when_s, alarm.name, alarm.kind, alarm.text, over)
        self._database.execute("INSERT INTO alarm VALUES (?, ?, ?, ?, ?)", row)

    def note_verdict(self, verdict: Verdict) -> None:
        """One row per diagnosis."""
        row = (verdict.at_unix_s, verdict.verdict, verdict.text, json.dumps(verdict.content))
        self._database.execute("INSERT INTO verdict VALUES (?, ?, ?, ?)", row)

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
