"""The helper that solves, publishes, judges, records and saves: `python -m rtid.daemon.analyst`.

It has time: its disk may be slow, a solve may take seconds.  What it cannot do it says.  Snapshots
are written as they come, beside the job in work: a kill must not cost what a solve takes.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from queue import Queue
from typing import Any, Literal

import numpy as np

from rtid.compare import CandidateMap
from rtid.compare.suspects import LikelyCause
from rtid.daemon import jobs
from rtid.daemon.books import Books
from rtid.daemon.edge_health import edges_of
from rtid.daemon.first import against_first
from rtid.daemon.guard import PROOF, TRUST, Guard, candidate_of, with_wear
from rtid.daemon.jobs import MOST_BYTES, Waiting
from rtid.daemon.map_check import Judge
from rtid.daemon.offering import Offering
from rtid.daemon.pipe import Pipe
from rtid.daemon.realtime import SWITCH_S, give_way, hasten
from rtid.daemon.shadow import Shadow
from rtid.daemon.status import EffectStatus
from rtid.daemon.wearing import WearWatch
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.solution import Solution
from rtid.maps.files import provenance, write_map
from rtid.maps.prior_map import find_prior, published
from rtid.plain import FloatArray
from rtid.project import Project, load
from rtid.study.on_board import learned_sizes, on_board
from rtid.trace.snapshot import Generations

NICE = 5
MAP_FILE = "map.npz"
KEPT = 3  # handovers that can be recalled
CLEAN_S = 2.0  # a handover must be older than a suspicion by the piece in which that began
JUDGED_S, JUDGED = 6.0, 2  # before a judgement; seconds that the guard has judged, a piece late
FIRST_S = 60.0  # of samples that a first map, or a later one, is checked by


class Analyst:
    """Takes jobs, answers through `answer`."""

    def __init__(
        self, project: Project, folder: Path, answer: Callable[[jobs.Answer], None]
    ) -> None:
        self._answer, self._project, self._prior = answer, project, find_prior(project)
        self._chambers = [chamber.name for chamber in project.model.chambers]
        self._generations, self._disk = Generations(folder, project.digest), threading.Lock()
        self._folder = folder
        self._books = Books(folder, project.sections.daemon.record_mb << 20, answer)
        self._judge: Judge | None = None
        self._handed: deque[jobs.Handover] = deque(maxlen=KEPT)
        self._offering = Offering(project, folder)
        self._guard: Guard | None = None
        self._baseline: Estimator | None = None
        self._is_named = True  # what contradicts the baseline, by what came behind the alarm
        self._next: tuple[jobs.Handover, CandidateMap] | None = None  # to become the baseline
        self._behind: deque[FloatArray] = deque()  # samples behind that one
        self._waiting_s: float | None = None  # newest sample of a snapshot not yet trusted
        self._trusted_s = -math.inf  # ... of the one on the disk that is
        self._saved = 0  # number of the newest handover that was to be written
        self._first: deque[FloatArray] = deque()  # samples of a first map
        self._shadow: Shadow | None = None  # of a baseline that is lost
        self._wearing = WearWatch()

    def begin(self) -> None:
        """Publish the baseline of before, which has to foretell the motion first."""
        result = self._generations.baseline(self._project.model)
        for reason in result.refused:
            self._books.refused("baseline", reason)
        self._books.put("points", lambda: self._generations.keep("start"))
        if result.estimator is None:
            return
        level = result.notes.get("level_m3s")
        job = jobs.Handover(0, result.estimator, publish=True, store=False)
        solved = self._tell(job)
        assert solved is not None, "only a first map can be refused"
        candidate = solved[1]
        self._baseline, self._trusted_s = result.estimator, _newest_s(result.estimator)
        known = None if level is None else np.array(level)
        share = float(result.notes.get("known_share", 0.0))
        self._guard = Guard(self._project.model, candidate, known, "proving", share)
        self._guard.worn += result.notes.get("worn", 0.0)
        if proof := self._generations.shadow(self._project.model).notes.get("proof"):
            self._guard.resume(proof)
        self._resume_trust(result.estimator)
        self._answer(jobs.Foretold("proving"))

    def _resume_trust(self, baseline: Estimator) -> None:
        """What a run before had saved waits on: killed again and again, none would ever be."""
        kept = self._generations.waiting(self._project.model).estimator
        if kept is not None and kept.origin_us == baseline.origin_us:
            self._waiting_s = _newest_s(kept) if _newest_s(kept) > self._trusted_s else None

    def take(self, job: jobs.Job) -> None:
        """Do one job; what is to be saved of it is for `save`.  What cannot be done is told."""
        try:
            self._do(job)
        except RtidError as error:
            self._books.refused("analysis", str(error))

    def _do(self, job: jobs.Job) -> None:
        if isinstance(job, jobs.Batch):
            self._batch(job)
        elif isinstance(job, jobs.Handover) and job.publish:
            try:
                self._publish(job)
                self._books.took("analysis")
            finally:
                self._answer(jobs.Ready(to_save=False))
        elif isinstance(job, jobs.Handover) and job.is_proving and self._guard is not None:
            self._cast(job, self._guard)
        elif isinstance(job, jobs.Note):
            self._books.note(job)
        elif isinstance(job, jobs.Recall):
            self._recall(job)
        elif isinstance(job, jobs.Relearn):
            self._relearn(job)
        elif isinstance(job, jobs.VerdictAnswer) and job.verdict is not None:
            verdict = job.verdict
            self._books.write(lambda history: history.note_verdict(verdict))

    def save(self, job: jobs.Handover) -> None:
        """Write the snapshot, in any thread."""
        path = None
        with self._disk:
            if job.number >= self._saved:  # else one that had to be on the disk has overtaken it
                path, self._saved = self._books.put("snapshot", lambda: self._save(job)), job.number
        if path is not None:
            self._answer(jobs.SavedSnapshot(job.number, str(path), job.made_s))
        self._answer(jobs.Ready(to_solve=False))

    def _save(self, job: jobs.Handover) -> Path:
        """As the state to go on with, or beside the baseline that has not proven itself yet."""
        guard = self._guard
        if guard is None or guard.state == "proven" or not job.is_proving:
            path = self._generations.save(job.estimator, not job.is_last, _notes(guard))
            if guard is not None and guard.state == "proven":
                self._await_trust(path, _newest_s(job.estimator))
            return path
        if guard.state == "contradicted":  # meanwhile: what it has learned is not to be kept
            return self._generations.baseline_path
        notes = {"proof": guard.progress}
        return self._generations.save_shadow(job.estimator, notes, not job.is_last)

    def _await_trust(self, path: Path, newest_s: float) -> None:
        """Keep a snapshot until the motion behind it shows that no fault was learned into it."""
        if self._waiting_s is None or newest_s < self._waiting_s:  # the clock was set
            self._generations.await_trust(path)
            self._waiting_s = newest_s

    def close(self) -> None:
        """Close the files; the newest estimate that can be trusted is the baseline on the disk."""
        trusted = [job.estimator for job in self._handed if self._is_trusted(job.estimator)]
        if trusted and _newest_s(trusted[-1]) > self._trusted_s:
            self._baseline = trusted[-1]
            self._store_baseline()
        self._books.close()

    def _recall(self, job: jobs.Recall) -> None:
        """Give back what was learned before, and publish it again."""
        older = [handover for handover in self._handed if handover.number <= job.number]
        if self._baseline is not None:
            older = self._before(older, job.before_s)
        older = older if older or self._baseline is not None else [*self._handed][:1]
        estimator = older[-1].estimator if older else self._baseline
        self._next = None
        self._wearing.forget()
        if estimator is not None:
            self._answer(jobs.Recalled(estimator))
            self._tell(jobs.Handover(job.number, estimator, publish=True, store=False))

    def _before(self, handed: list[jobs.Handover], before_s: float) -> list[jobs.Handover]:
        """Those that a suspicion does not reach, of a run whose baseline has foretold the motion.

        The baseline is older by what it takes to prove it: what was learned meanwhile stays.
        """
        if self._guard is None or not self._guard.has_foretold:
            return []
        return [job for job in handed if _newest_s(job.estimator) <= before_s - CLEAN_S]

    def _watch(self, chunk: FloatArray) -> None:
        """Hold the baseline against the samples; a map that foretells as well takes its place."""
        guard = self._guard
        if guard is None:
            _keep(self._first, chunk)
            return
        had_level = guard.level is not None
        if self._shadow is not None and self._lead(guard, self._shadow, chunk):
            return
        if guard.push(chunk):
            self._judged(guard)
        elif not self._is_named and (causes := guard.later_causes()) is not None:
            words = _foretold("named", guard, causes)
            if words.text:
                self._is_named = True
                self._answer(words)
        if guard.level is not None and not had_level:
            self._store_baseline()
        waiting_s = self._waiting_s
        if waiting_s is not None and guard.is_calm_behind(waiting_s, TRUST):
            self._trust(waiting_s)
        if self._next is not None:
            self._follow(guard, chunk, *self._next)

    def _follow(
        self, guard: Guard, chunk: FloatArray, job: jobs.Handover, candidate: CandidateMap
    ) -> None:
        """Make a later map the baseline, once both have foretold the motion behind it."""
        _keep(self._behind, chunk)
        if guard.is_calm_behind(_newest_s(job.estimator), PROOF):
            self._next = None
            if guard.foretells(candidate, np.concatenate(self._behind)):
                self._baseline = job.estimator
                guard.follow(candidate)

    def _is_judged(self, t_s: float) -> bool:
        """Whether the guard answers for the seconds before a time."""
        return self._guard is not None and self._guard.answers_for(t_s - JUDGED_S, JUDGED)

    def _is_trusted(self, estimator: Estimator) -> bool:
        """Whether the motion behind what it has learned shows no fault."""
        return self._guard is not None and self._guard.is_calm_behind(_newest_s(estimator), TRUST)

    def _trust(self, newest_s: float) -> None:
        """What was saved before this motion goes on being published after a kill."""
        with self._disk:
            if self._waiting_s != newest_s:  # another one was saved meanwhile
                return
            self._books.put("baseline", self._generations.trust)
            self._trusted_s, self._waiting_s = newest_s, None
        self._books.put("points", lambda: self._generations.keep("publish"))

    def _lead(self, guard: Guard, shadow: Shadow, chunk: FloatArray) -> bool:
        """Whether what was learned in the shadow takes the place of a baseline that is lost."""
        stands = shadow.push(chunk)
        if stands or not guard.is_lost:
            self._shadow = None
        if not (stands and guard.is_lost):
            return False
        self._guard, self._baseline = shadow.guard, shadow.job.estimator
        self._wearing.forget()
        self._judged(shadow.guard)
        self._store_baseline()
        return True

    def _cast(self, job: jobs.Handover, guard: Guard) -> None:
        """Try what was learned without proof, where the baseline cannot say anything."""
        if guard.is_lost and not (self._shadow is not None and self._shadow.is_of_use):
            with np.errstate(divide="ignore"):
                solution = job.estimator.solution()
                candidate = candidate_of(solution, published(solution, self._prior))
            self._shadow = Shadow(job, solution, candidate, guard.level)

    def _judged(self, guard: Guard) -> None:
        """The baseline has foretold the motion, or does not."""
        if guard.state == "contradicted":
            self._next = None
            with self._disk:
                self._waiting_s = None
                self._books.put("snapshot", self._generations.distrust)
                self._books.put("snapshot", self._generations.drop_shadow)
            self._books.put("points", lambda: self._generations.keep("alarm"))
            self._answer(_foretold("contradicted", guard, guard.causes()))
            self._is_named = False  # but by few seconds, of which some may be healthy
        else:
            self._answer(jobs.Foretold("proven"))

    def _store_baseline(self) -> None:
        """Write the baseline with its level, and now and then a point in time."""
        baseline, notes = self._baseline, _notes(self._guard)
        if baseline is None:
            return
        self._trusted_s = _newest_s(baseline)
        self._books.put("baseline", lambda: self._generations.save_baseline(baseline, notes))
        self._books.put("points", lambda: self._generations.keep("publish"))

    def _is_fit(self, job: jobs.Handover, solution: Solution) -> bool:
        """Whether a first map may be published; from then on it is the baseline."""
        if not self._first:
            return True
        chunk = np.concatenate(self._first)
        if words := against_first(self._project.model, chunk, solution):
            self._answer(jobs.Foretold("refused", text="; ".join(words)))
            return False
        self._baseline = job.estimator
        return True

    def _batch(self, batch: jobs.Batch) -> None:
        if self._judge is not None:
            judgement = self._judge.push(batch.chunk)
            if judgement is not None:
                self._answer(replace(judgement, is_guarded=self._is_judged(judgement.t_s)))
        if len(batch.chunk):
            self._watch(batch.chunk)
        self._books.put("offer", lambda: self._offering.push(batch.chunk))
        if batch.frames is not None:
            self._books.record(batch.frames)

    def _relearn(self, job: jobs.Relearn) -> None:
        """Begin anew with the machine as it is; what was learned before is kept aside."""
        estimator = Estimator(self._project.model)
        estimator.history, estimator.origin_us = None, job.origin_us
        estimator.advance(job.chunk)
        self._handed.clear()
        self._guard = self._baseline = self._next = self._shadow = None
        self._wearing.forget()
        self._answer(jobs.Recalled(estimator, is_accepted=True))
        with self._disk:
            self._waiting_s = None
            self._books.put("snapshot", lambda: self._generations.set_aside("accept"))
            self._books.put("snapshot", lambda: self._generations.save(estimator))
        self._books.write(lambda history: history.note_acceptance(job.acceptance))

    def _publish(self, job: jobs.Handover) -> None:
        if not len(job.estimator.sums.blocks):
            return
        self._handed.append(job)
        solved = self._tell(job)
        if solved is None:
            return
        solution, candidate = solved
        if self._guard is None:
            self._guard = Guard(self._project.model, candidate, None, "proven")
            self._first.clear()
            self._store_baseline()
        elif self._guard.level is None and self._guard.state == "proven":
            self._baseline = job.estimator  # the first maps: each is known for more places
            self._guard.follow(candidate)
        else:
            if self._next is None:
                self._next = job, candidate
                self._behind.clear()
            self._follow_wear(self._guard, job.estimator, solution)

    def _follow_wear(self, guard: Guard, estimator: Estimator, solution: Solution) -> None:
        """Carry over what is known to a machine that does what the map says, but for slow wear."""
        if solution.model.upkeep.fades or not guard.is_calm_behind(-math.inf, 1):
            return
        wear = self._wearing.push(estimator.sums, solution, guard.moved)
        if wear is None:
            return
        known = [job.estimator for job in self._handed]
        known += [e for e in (self._baseline, self._next and self._next[0].estimator) if e]
        for each in {id(each): each for each in known}.values():
            each.carry_over(wear)
        guard.carry_over(wear)
        if self._next is not None:
            job, candidate = self._next
            self._next = job, with_wear(solution.model, candidate, wear)
        self._answer(jobs.Worn(wear))
        edges, worn = solution.model.edges, guard.worn
        self._books.write(lambda history: history.note_wear(edges, worn))

    def _tell(self, job: jobs.Handover) -> tuple[Solution, CandidateMap] | None:
        """Solve, judge from now on, and publish; None for a first map that cannot be."""
        start_s = time.monotonic()
        with np.errstate(divide="ignore"):  # compliance 0: the motion has not shown it yet
            solution = job.estimator.solution()
            if self._guard is None and self._baseline is None and not self._is_fit(job, solution):
                return None
            self._judge = Judge(job, solution)
            flow_map = published(solution, self._prior)
            beta_pa, beta_sd_pa = solution.beta_pa, solution.beta_sd_pa
        result = jobs.Publication(
            job.number,
            flow_map,
            beta_pa,
            beta_sd_pa,
            float(solution.rho),
            _newest_s(job.estimator),
            edges_of(job.estimator, solution, flow_map),
            time.monotonic() - start_s,
            tuple(EffectStatus(*size) for size in learned_sizes(self._project, solution)),
        )
        self._answer(result)
        self._offering.published(result, solution)
        self._books.put("map", lambda: self._write_map(flow_map, solution))
        self._books.write(lambda history: history.note_publication(result, self._chambers))
        return solution, candidate_of(solution, flow_map)

    def _write_map(self, flow_map: FlowMap, solution: Solution) -> None:
        """Replace the map in the folder, for the page and for `rtid compare --map`."""
        origin = provenance(solution, self._project.name, self._project.digest, "rtid run")
        temporary = self._folder / f"part-{MAP_FILE}"
        write_map(temporary, flow_map, origin)
        os.replace(temporary, self._folder / MAP_FILE)


def _foretold(
    state: Literal["contradicted", "named"], guard: Guard, causes: list[LikelyCause]
) -> jobs.Foretold:
    """A contradiction in words: what would mend it, else what speaks against the samples."""
    mended = ", or ".join(cause.text for cause in causes)
    text = f"It would do so again with: {mended}" if mended else "; ".join(guard.against)
    of_sensor = bool(text) and all(cause.of_sensor for cause in causes)
    return jobs.Foretold(state, guard.since_s, text, of_sensor)


def _keep(chunks: deque[FloatArray], chunk: FloatArray) -> None:
    """Add samples (n, 2 + signals), and let go what is older than FIRST_S."""
    chunks.append(chunk)
    while chunks[0][0, 0] < chunk[-1, 0] - FIRST_S:
        chunks.popleft()


def _newest_s(estimator: Estimator) -> float:
    """Time of the newest sample that was learned."""
    return float(estimator.state.engine[0]["t_s"])


def _notes(guard: Guard | None) -> dict[str, Any]:
    """What a start has to know of a baseline, for JSON."""
    if guard is None:
        return {}
    level = None if guard.level is None else guard.level.tolist()
    worn, share = guard.worn.tolist(), guard.known_share
    return {"level_m3s": level, "known_share": share, "worn": worn, "unix_s": time.time()}


def main() -> None:
    """Serve the daemon at the other end of the pipe until it says None or is gone."""
    sys.setswitchinterval(SWITCH_S)  # a save must not wait for what solves
    fd, project, folder = sys.argv[1:]
    pipe, one_at_a_time = Pipe(int(fd)), threading.Lock()

    def answer(reply: jobs.Answer) -> None:
        with one_at_a_time:
            pipe.send(reply)

    begun, waiting = Queue[Analyst](), Waiting(MOST_BYTES)
    nice = os.getpriority(os.PRIO_PROCESS, 0) + NICE

    def saved() -> None:
        give_way(os.getpid(), nice)  # the main thread alone

    def receive() -> None:
        analyst = begun.get()
        hasten(threading.get_native_id(), loaded.sections.daemon.priority > 0)
        _receive(pipe, analyst, waiting, saved)

    receiver = threading.Thread(target=receive, daemon=True)
    receiver.start()  # before this thread, and all that it starts, is nice: to save does not wait
    loaded = on_board(load(project), lambda _: None)
    Estimator(loaded.model).solution()  # compiles
    analyst = Analyst(loaded, Path(folder), answer)
    try:
        analyst.begin()
        saved()  # not before: until it is ready nothing of what is learned is saved
        answer(jobs.Ready())
        begun.put(analyst)
        while (job := waiting.get()) is not None:
            analyst.take(job)
    except OSError:
        pass  # the daemon is gone; what it had was stored by the last job
    analyst.close()


def _receive(pipe: Pipe, analyst: Analyst, waiting: Waiting, saved: Callable[[], None]) -> None:
    """Queue the jobs, and save what is to be saved of them at once.

    What solves holds the interpreter for tenths of a second of its processor time, within scipy: a
    save would wait for all to which it gives way. So the daemon hastens it with what is to be
    saved, and it gives way again when that is `saved`.
    """
    try:
        while (job := pipe.receive()) is not None:
            if isinstance(job, jobs.Handover) and job.store:
                analyst.save(job)
                saved()
            waiting.put(job)
    except (EOFError, OSError):
        pass  # the daemon is gone
    finally:
        waiting.put(None)


if __name__ == "__main__":
    main()
