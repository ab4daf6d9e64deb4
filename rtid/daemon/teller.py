"""Makes the status once a second: what loop, gates, helpers and disk have come to."""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

from rtid.daemon import status as st
from rtid.daemon.alarms import Alarms
from rtid.daemon.core import Core
from rtid.daemon.diagnosing import Diagnosing
from rtid.daemon.jobs import NotSaved, Publication, SavedAgain, SavedSnapshot
from rtid.daemon.loop import Loop
from rtid.daemon.story import loop_health, resident_mb
from rtid.project import Project

# alarms while which nothing is learned
HOLDING = ("implausible", "signal_range", "sensor_frozen", "second_sender")
LEAST_FREE = 64 << 10  # bytes that any snapshot needs
GRACE_S = 15.0  # a save may take so long before its absence is an alarm


@dataclass(frozen=True)
class Facts:
    """What does not change while the daemon runs."""

    project: Project
    folder: Path
    interface: str
    channel: str
    restored: str
    scheduling: str
    memory_locked: bool
    started_unix_s: float
    log_every_s: float
    learned: Path | None = None  # folder of the project's snapshots


@dataclass
class Saving:
    """What the disk has taken, and what it has refused."""

    interval_s: float
    folder: Path
    needed: int = LEAST_FREE  # bytes of a snapshot
    started_s: float = field(default_factory=time.monotonic)
    saved_s: float | None = None
    idle_s: float | None = None  # when nothing was learned last, and so nothing was to be saved
    refused: dict[str, str] = field(default_factory=dict)

    def hear(self, answer: SavedSnapshot | NotSaved | SavedAgain) -> None:
        """The analyst has saved, could not, or can again: a snapshot says nothing of the others."""
        if isinstance(answer, SavedAgain):
            self.refused.pop(answer.what, None)
        elif isinstance(answer, SavedSnapshot):
            self.saved_s = answer.made_s
            with contextlib.suppress(OSError):
                self.needed = max(LEAST_FREE, os.stat(answer.path).st_size)
        else:
            self.refused[answer.what] = answer.reason

    def why_not(self, is_learning: bool) -> str:
        """Why what was learned would not survive; "" if it would."""
        if self.refused:
            return "NOT SAVED: " + "; ".join(f"{w}: {r}" for w, r in self.refused.items())
        if is_learning and (short := short_of_room(self.folder, self.needed)):
            return f"NOT SAVED: {short}"
        now_s = time.monotonic()
        if not is_learning:
            self.idle_s = now_s
        age_s = now_s - max(self.started_s, self.saved_s or 0.0, self.idle_s or 0.0)
        if is_learning and age_s > self.interval_s + GRACE_S:
            return f"NOT SAVED: no snapshot for {age_s:.0f} s"
        return ""

    def store(self, why: str, restored: str, recording: str, dropped: int) -> st.Store:
        """As the status has it."""
        age_s = None if self.saved_s is None else time.monotonic() - self.saved_s
        store = st.Store("none", why, age_s, restored, recording, dropped)
        if why:
            return replace(store, state="NOT SAVED")
        return store if age_s is None else replace(store, state="saved")


def short_of_room(folder: Path, needed: int) -> str:
    """Why the disk would not take so many bytes now, "" if it would: before it has refused them."""
    try:
        disk = os.statvfs(folder)
    except OSError as error:
        return f"{folder}: {error.strerror}"
    free = (disk.f_bfree if os.geteuid() == 0 else disk.f_bavail) * disk.f_frsize
    if disk.f_flag & os.ST_RDONLY:
        return f"{folder} is read-only"
    if disk.f_blocks and free < needed:
        return f"{folder}: {free >> 10} KB are free, a snapshot needs {needed >> 10} KB"
    return ""


class Teller:
    """Makes statuses; asked once a second."""

    def __init__(self, facts: Facts, core: Core) -> None:
        self._facts, self._core = facts, core
        self.loop: Loop | None = None
        self.publication: Publication | None = None
        self.version = 0
        self._frames_before = 0

    def publish(self, publication: Publication) -> None:
        """Another map is known."""
        self.publication = publication
        self.version += 1

    def tell(
        self,
        alarms: Alarms,
        store: st.Store,
        surprise: float | None,
        diagnosing: Diagnosing,
        advice: st.Advice | None,
    ) -> st.Status:
        """The status of now."""
        facts, now_ns = self._facts, time.monotonic_ns()
        messages, signals = self._core.health.take(now_ns)
        counters = self._core.learner.counters
        return st.Status(
            name=facts.project.name,
            pid=os.getpid(),
            started_unix_s=facts.started_unix_s,
            now_unix_s=time.time(),
            loop=loop_health(self.loop, facts.project, facts.scheduling, facts.memory_locked),
            bus=self._bus(counters),
            messages=messages,
            signals=signals,
            estimate=self._estimate(now_ns, counters, alarms, surprise),
            store=store,
            verdict=diagnosing.verdict,
            diagnosing=diagnosing.is_running,
            advice=advice,
            alarms=alarms.all,
            rss_anon_mb=resident_mb(),
            scope=self._core.scope.take(),
        )

    def _bus(self, counters: dict[str, int]) -> st.BusHealth:
        facts, core = self._facts, self._core
        frames, self._frames_before = core.frames - self._frames_before, core.frames
        return st.BusHealth(
            facts.interface,
            facts.channel,
            "reopening" if core.source.is_down else "open",
            core.frames,
            float(frames),
            core.source.queued,
            counters.get("reopened", 0),
            core.learner.assembler.source_counters,
        )

    def _estimate(
        self, now_ns: int, counters: dict[str, int], alarms: Alarms, surprise: float | None
    ) -> st.EstimateStatus:
        core, publication = self._core, self.publication
        age_s = core.lag.age_s(now_ns // 1000)
        learning: st.Learning = "learning" if core.samples else "waiting"
        reason = ""
        quarantine = [alarm.text for alarm in alarms.on if alarm.name in HOLDING]
        if not core.learner.learns and (alarms.has("plant_changed") or not quarantine):
            learning, reason = "suspended", "the plant has changed"
        elif quarantine:
            learning, reason = "held", quarantine[0]
        elif core.is_proving:
            reason = "in the shadow: the map held has to foretell the motion first"
        shown = st.EstimateStatus(
            state=learning,
            reason=reason,
            version=self.version,
            age_s=age_s,
            stale=age_s is None or age_s > self._facts.project.sections.daemon.max_age_s,
            samples=counters.get("samples", 0),
            rows=counters.get("rows", 0),
            surprise=surprise,
            refused=counters,
        )
        if publication is None:
            return shown
        names = [chamber.name for chamber in self._facts.project.model.chambers]
        rows = zip(names, publication.beta_pa, publication.beta_sd_pa, strict=True)
        chambers = tuple(st.ChamberStatus(name, float(beta), float(sd)) for name, beta, sd in rows)
        edges, effects = publication.edges, publication.effects
        return replace(shown, rho=publication.rho, chambers=chambers, edges=edges, effects=effects)
