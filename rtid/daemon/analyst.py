"""The helper that solves, publishes, judges, records and saves: `python -m rtid.daemon.analyst`.

It has time: its disk may be slow, a solve may take seconds.  What it cannot do it says.  Snapshots
are written as they come, beside the job in work: a kill must not cost what a solve takes.
"""

from __future__ import annotations

import os
import sqlite3
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from queue import Queue
from typing import TypeVar

import numpy as np

from rtid.daemon import jobs
from rtid.daemon.chronicle import Chronicle
from rtid.daemon.configure import boarded
from rtid.daemon.judge import Judge
from rtid.daemon.offering import Offering
from rtid.daemon.pipe import Pipe
from rtid.daemon.recorder import Recorder
from rtid.daemon.status import EdgeHealth
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.solution import Solution
from rtid.mapfiles import provenance, write_map
from rtid.priors import find_prior, published
from rtid.project import Project, load
from rtid.store import Generations

T = TypeVar("T")
NICE = 5
MAP_FILE = "map.npz"
KEPT = 3  # handovers that can be recalled
QUEUED = 100  # jobs taken from the pipe while one is in work
FLOOD_S = 10.0  # the same refusal of the disk is told at most this often


class Analyst:
    """Takes jobs, answers through `answer`."""

    def __init__(
        self, project: Project, folder: Path, answer: Callable[[jobs.Answer], None]
    ) -> None:
        self._answer, self._project, self._prior = answer, project, find_prior(project)
        self._chambers = [chamber.name for chamber in project.model.chambers]
        self._generations, self._disk = Generations(folder, project.digest), threading.Lock()
        limit_bytes = project.sections.daemon.record_mb << 20
        self._folder = folder
        self._recorder: Recorder | None = None
        self._limit_bytes = limit_bytes
        self._chronicle: Chronicle | None = None
        self._judge: Judge | None = None
        self._segment = ""
        self._told: dict[str, float] = {}
        self._handed: deque[jobs.Handover] = deque(maxlen=KEPT)
        self._offering = Offering(project, folder)

    def take(self, job: jobs.Job) -> None:
        """Do one job; what is to be saved of it is for `save`."""
        if isinstance(job, jobs.Batch):
            self._batch(job)
        elif isinstance(job, jobs.Handover) and job.publish:
            try:
                self._publish(job)
            finally:
                self._answer(jobs.Ready(to_save=False))
        elif isinstance(job, jobs.Note):
            self._note(job)
        elif isinstance(job, jobs.Recall) and self._handed:
            wanted = [one for one in self._handed if one.number <= job.number]
            found = wanted[-1] if wanted else self._handed[0]
            self._answer(jobs.Recalled(found.estimator))
        elif isinstance(job, jobs.Relearn):
            self._relearn(job)
        elif isinstance(job, jobs.Found) and job.verdict is not None:
            verdict = job.verdict
            self._guarded("history", lambda: self._history().note_verdict(verdict))

    def save(self, job: jobs.Handover) -> None:
        """Write the snapshot, in any thread."""
        with self._disk:
            path = self._guarded("snapshot", lambda: self._generations.save(job.estimator))
        if path is not None:
            self._answer(jobs.Saved(job.number, str(path)))
        self._answer(jobs.Ready(to_solve=False))

    def close(self) -> None:
        """Close the files."""
        if self._recorder is not None:
            self._recorder.close()
        if self._chronicle is not None:
            self._chronicle.close()

    def _batch(self, batch: jobs.Batch) -> None:
        if self._judge is not None:
            judgement = self._judge.push(batch.chunk)
            if judgement is not None:
                self._answer(judgement)
        self._guarded("offer", lambda: self._offering.push(batch.chunk))
        frames = batch.frames
        if frames is not None and self._limit_bytes:
            self._guarded("recording", lambda: self._record().write(frames))
            if self._recorder is not None and self._recorder.path != self._segment:
                self._segment = self._recorder.path
                self._answer(jobs.Recording(self._segment))

    def _relearn(self, job: jobs.Relearn) -> None:
        """Begin anew with the machine as it is; what was learned before is kept aside."""
        estimator = Estimator(self._project.model)
        estimator.history, estimator.origin_us = None, job.origin_us
        estimator.advance(job.chunk)
        self._handed.clear()
        self._answer(jobs.Recalled(estimator, is_accepted=True))
        with self._disk:
            self._guarded("snapshot", self._generations.set_aside)
            self._guarded("snapshot", lambda: self._generations.save(estimator))
        self._guarded("history", lambda: self._history().note_acceptance(job.acceptance))

    def _publish(self, job: jobs.Handover) -> None:
        if not len(job.estimator.sums.blocks):
            return
        self._handed.append(job)
        start_s = time.monotonic()
        with np.errstate(divide="ignore"):  # compliance 0: the motion has not shown it yet
            solution = job.estimator.solution()
            self._judge = Judge(job, solution)
            flow_map = published(solution, self._prior)
            beta_pa, beta_sd_pa = solution.beta_pa, solution.beta_sd_pa
        found = jobs.Publication(
            job.number,
            flow_map,
            beta_pa,
            beta_sd_pa,
            float(solution.rho),
            float(job.estimator.state.engine[0]["t_s"]),
            edges_of(job.estimator, solution, flow_map),
            time.monotonic() - start_s,
        )
        self._answer(found)
        self._offering.published(found, solution)
        self._guarded("map", lambda: self._write_map(flow_map, solution))
        self._guarded("history", lambda: self._history().note_publication(found, self._chambers))

    def _write_map(self, flow_map: FlowMap, solution: Solution) -> None:
        """Replace the map in the folder, for the page and for `rtid compare --map`."""
        told = provenance(solution, self._project.name, self._project.digest, "rtid run")
        temporary = self._folder / f"part-{MAP_FILE}"
        write_map(temporary, flow_map, told)
        os.replace(temporary, self._folder / MAP_FILE)

    def _note(self, note: jobs.Note) -> None:
        self._guarded("history", lambda: self._history().note_alarm(note.alarm))
        if note.keep and self._limit_bytes:
            alarm = note.alarm
            keep = self._guarded(
                "recording", lambda: self._record().keep(alarm.name, alarm.since_unix_s)
            )
            kept = {alarm.name: keep} if keep else {}
            self._answer(jobs.Recording(self._recorder.path if self._recorder else "", kept))

    def _record(self) -> Recorder:
        if self._recorder is None:
            self._recorder = Recorder(self._folder, self._limit_bytes)
        return self._recorder

    def _history(self) -> Chronicle:
        if self._chronicle is None:
            self._chronicle = Chronicle(self._folder)
        return self._chronicle

    def _guarded(self, what: str, action: Callable[[], T]) -> T | None:
        """Do something with the disk; a refusal is told, and tried again with the next job."""
        try:
            return action()
        except (OSError, sqlite3.Error) as error:
            now_s = time.monotonic()
            if now_s >= self._told.get(what, 0.0):
                self._told[what] = now_s + FLOOD_S
                self._answer(jobs.NotSaved(what, str(error)))
        return None


def edges_of(estimator: Estimator, solution: Solution, flow_map: FlowMap) -> tuple[EdgeHealth, ...]:
    """Blocks and cells of each edge by status."""
    found = []
    for i, edge in enumerate(estimator.model.edges):
        mine = [block for block in solution.blocks if block.edge == i]
        cells = Counter(str(status) for status in flow_map.edges[i].status.ravel())
        progress = sum(block.progress for block in mine) / max(1, len(mine))
        blocks = Counter(block.status for block in mine)
        found.append(EdgeHealth(edge.name, dict(blocks), dict(cells), progress))
    return tuple(found)


def main() -> None:
    """Serve the daemon at the other end of the pipe until it says None or is gone."""
    fd, project, folder = sys.argv[1:]
    pipe, one_at_a_time = Pipe(int(fd)), threading.Lock()

    def answer(told: jobs.Answer) -> None:
        with one_at_a_time:
            pipe.send(told)

    os.nice(NICE)
    loaded = boarded(load(project), lambda _: None)
    Estimator(loaded.model).solution()  # compiles
    analyst = Analyst(loaded, Path(folder), answer)
    waiting: Queue[jobs.Job | None] = Queue(QUEUED)
    receiver = threading.Thread(target=_receive, args=(pipe, analyst, waiting), daemon=True)
    try:
        answer(jobs.Ready())
        receiver.start()
        while (job := waiting.get()) is not None:
            try:
                analyst.take(job)
            except RtidError as error:
                answer(jobs.NotSaved("analysis", str(error)))
    except OSError:
        pass  # the daemon is gone; what it had was stored by the last job
    analyst.close()


def _receive(pipe: Pipe, analyst: Analyst, waiting: Queue[jobs.Job | None]) -> None:
    """Queue the jobs, and save what is to be saved of them at once."""
    try:
        while (job := pipe.receive()) is not None:
            if isinstance(job, jobs.Handover) and job.store:
                analyst.save(job)
            waiting.put(job)
    except (EOFError, OSError):
        pass  # the daemon is gone
    finally:
        waiting.put(None)


if __name__ == "__main__":
    main()
