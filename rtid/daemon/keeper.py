"""The housekeeper: a thread beside the loop that hears answers, raises alarms and tells the status.

It looks ten times a second and tells once a second; it only reads what the loop counts.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from statistics import median

from rtid.daemon import jobs, realtime, wording
from rtid.daemon import status as st
from rtid.daemon.acceptance import Acceptance, taken
from rtid.daemon.alarms import Alarms
from rtid.daemon.coaching import Coaching
from rtid.daemon.core import Core
from rtid.daemon.diagnosing import Diagnosing, newest
from rtid.daemon.helper import Helper
from rtid.daemon.log import logger
from rtid.daemon.plant_watch import PlantWatch
from rtid.daemon.story import line
from rtid.daemon.suspension import remember, suspended
from rtid.daemon.teller import Facts, Saving, Teller

LOOK_S = 0.1
OVERLOAD, LOADS = 0.05, 5  # share of ticks lost in most of so many looks that is worth an alarm
SAVES = 0.8  # what one save took counts for the next ones: on a busy computer some take long
CHECK_S = 30.0  # of samples after which the project file is held against them
BEGINS_S = 5.0  # so long after the start nobody misses a message
FALLEN_S = 60.0  # so long a helper that ended is an alarm


class Keeper:
    """Looks after everything that is not the loop; `status` is the newest one."""

    def __init__(
        self,
        facts: Facts,
        core: Core,
        analyst: Helper,
        diagnosing: Diagnosing,
        coaching: Coaching,
        answers: deque[jobs.Answer],
    ) -> None:
        self._facts, self._core, self._analyst = facts, core, analyst
        self._diagnosing, self._coaching = diagnosing, coaching
        self.teller = Teller(facts, core)
        self.alarms = Alarms(self._told)
        self.plant = PlantWatch()
        self._answers = answers  # of the helpers, appended from their threads
        self._saving = Saving(facts.project.sections.daemon.store_s, facts.folder)
        self._recording = ""
        self._cause: jobs.Foretold | None = None  # what contradicts the baseline
        self._refused = ""  # why the first map was not published
        self._is_quarantined = False
        self._first_s: float | None = None  # time of the first sample of this run
        self._is_checked = self._is_ready = False
        self._told_s = 0.0
        self._is_news = False  # what is told at once
        self._loads: deque[tuple[int, int, Counter[str]]] = deque(maxlen=LOADS + 1)
        self._deaf = ""  # why no request can be taken
        self._fallen = 0
        self._fallen_s = -math.inf
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="rtid-keeper", daemon=True)
        self.status = self._make_status()

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """Look once more, tell the last status, and end."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._listen()
        self._tell()

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stopped.wait(LOOK_S):
            for step in (self._listen, self._look, self._hear_request):
                self._survived(step)
            if time.monotonic() >= next_s:
                next_s = time.monotonic() + 1.0
                self._survived(self._tell)
                if self._facts.project.sections.daemon.priority:
                    realtime.favour_threads()  # also those that have begun since

    def _survived(self, step: Callable[[], None]) -> None:
        """Take a step; one that fails must not keep the others from being taken."""
        try:
            step()
        except Exception:  # the keeper must not die: without it nobody hears of anything
            logger.exception("keeper failed")

    def _listen(self) -> None:
        while self._answers:
            answer = self._answers.popleft()
            if isinstance(answer, jobs.Ready):
                self._core.is_solving &= not answer.to_solve
                self._core.is_saving &= not answer.to_save
            elif isinstance(answer, jobs.Publication):
                self.teller.publish(answer)
                self._coaching.published(answer)
            elif isinstance(answer, jobs.HandoverJudgement):
                if self.plant.push(answer):
                    self._plant_changed()
            elif isinstance(answer, jobs.SavedSnapshot | jobs.NotSaved | jobs.SavedAgain):
                self._saving.hear(answer)
                if isinstance(answer, jobs.SavedSnapshot):
                    took_s = time.monotonic() - answer.made_s
                    self._core.save_s = max(took_s, SAVES * self._core.save_s)
                    self._is_news = True  # how old the state on the disk is
            elif isinstance(answer, jobs.RecorderState):
                self._recording = answer.path
                for name, folder in answer.kept.items():
                    self.alarms.keep(name, folder)
            elif isinstance(answer, jobs.Recalled):
                self._recalled(answer)
            elif isinstance(answer, jobs.Worn):
                self._core.worn = answer.wear
            elif isinstance(answer, jobs.Foretold):
                self._foretold(answer)
            elif isinstance(answer, jobs.Coached):
                self._coaching.take(answer)
            elif isinstance(answer, jobs.VerdictAnswer | jobs.Checked):
                self._analyst.put(answer)
                self._diagnosing.take(answer)
                acquitted = self._diagnosing.is_acquitted and not self.plant.contradicted
                if acquitted and self.plant.changed:
                    self.plant.accept()
                    self._plant_changed()

    def _recalled(self, answer: jobs.Recalled) -> None:
        """Another estimate is gone on with."""
        self._core.swap = answer.estimator
        if answer.is_accepted:
            self.plant.accept()
            self._core.is_proving = False
            self._plant_changed()

    def _foretold(self, answer: jobs.Foretold) -> None:
        """The baseline has to prove itself, has done so, or is contradicted."""
        self._core.is_proving = answer.state == "proving"
        if answer.state == "proving":
            self._cause = stored = suspended(self._facts.learned)
            if stored is not None:
                self.plant.contradict(0.0)
                self._core.learner.learns = False
        elif answer.state == "proven":
            logger.info("the map held foretells the motion: what is learned counts")
            if self.plant.contradicted:
                self.plant.accept()
                self._plant_changed()
        elif answer.state == "contradicted":
            self._cause = answer
            self.plant.contradict(answer.since_s)
            self._plant_changed()
        elif answer.state == "named":
            if self.plant.contradicted:
                self._cause = answer
                remember(self._facts.learned, answer, is_changed=True)
        else:
            self._refused = answer.text

    def _plant_changed(self) -> None:
        """Stop learning and go back to what was learned before, or go on."""
        self._core.learner.learns = not (self.plant.changed or self._is_quarantined)
        if not self.plant.changed:
            self._cause = None
        remember(self._facts.learned, self._cause, self.plant.changed)
        if self.plant.changed:
            logger.warning("plant changed: learning is suspended, surprise=%.1f level=%.1f",
                           self.plant.surprise or 0.0, self.plant.level)  # fmt: skip
            self._analyst.put(jobs.Recall(self.plant.trusted, self.plant.since_s))
            self._diagnosing.begin(self.plant.since_s)
        else:
            logger.info("plant as before: learning goes on")
            self._diagnosing.end()

    def _look(self) -> None:
        """Raise and clear alarms."""
        learner, source, project = self._core.learner, self._core.source, self._facts.project
        names = [message.name for message in project.assembly.messages]
        doubted = [n for n, bad in zip(names, learner.senders.doubted, strict=True) if bad]
        self.alarms.put("second_sender", "bus", wording.second_sender(doubted))
        taken = zip(names, learner.senders.channels.tolist(), strict=True)
        doubled = {name: channel for name, channel in taken if channel >= 0}
        self.alarms.put("several_channels", "bus", wording.several_channels(doubled))
        signals = [source.name for source in project.assembly.signals]
        frozen = [n for n, bad in zip(signals, learner.frozen.doubted, strict=True) if bad]
        self.alarms.put("sensor_frozen", "sensor", wording.frozen(frozen))
        where = f"{self._facts.interface} {self._facts.channel}"
        self.alarms.put("bus_down", "bus", wording.bus_down(where) if source.is_down else "")
        if self._analyst.failures != self._fallen:
            self._fallen, self._fallen_s = self._analyst.failures, time.monotonic()
        late = time.monotonic() - self._fallen_s > FALLEN_S
        self.alarms.put(
            "helper_failed", "loop", "" if late else wording.helper_failed(self._fallen)
        )
        self.alarms.put("not_saved", "store", self._why_not_saved())
        verdict = self._diagnosing.verdict if self._diagnosing.is_of_change else None
        cause = self._cause or jobs.Foretold("proven")
        of_sensor = cause.of_sensor if cause.text else verdict is not None and verdict.of_sensor
        text = wording.plant_changed(verdict, cause.text) if self.plant.changed else ""
        self.alarms.put("plant_changed", "sensor" if of_sensor else "plant", text)
        implausible = "; ".join(filter(None, (*self._diagnosing.implausible, self._refused)))
        self.alarms.put("implausible", "sensor", implausible)
        self._look_at_quarantine(bool(implausible))
        if not self._is_checked and self._recording and self._has_run_s() > CHECK_S:
            self._is_checked = self._diagnosing.check(self._recording)
        self._diagnosing.look(learner.estimator, self._core.newest_s)
        if learner.learns and not self._diagnosing.is_running:
            self._coaching.look(learner.estimator)
        self._look_at_load()
        if self._is_news or self.alarms.on != self.status.on:
            self._tell_news()

    def _look_at_quarantine(self, implausible: bool) -> None:
        """Nothing is learned while a sensor cannot be believed."""
        before = self._is_quarantined
        self._is_quarantined = implausible or self.alarms.has("signal_range")
        if self._is_quarantined == before:
            return
        self._core.learner.learns = not (self.plant.changed or self._is_quarantined)
        if implausible:
            self._analyst.put(jobs.Recall(self.plant.trusted, -math.inf))

    def _look_at_load(self) -> None:
        """Ticks that were lost within the last few looks; one stall is no overload."""
        if self.teller.loop is None:
            return
        total = self.teller.loop.total
        lost = total.overruns + total.skipped
        self._loads.append((total.ticks + total.skipped, lost, Counter(total.causes)))
        (due_0, lost_0, causes_0), (due, lost, causes) = self._loads[0], self._loads[-1]
        looks = pairwise(self._loads)
        shares = [(l1 - l0) / max(1, d1 - d0) for (d0, l0, _), (d1, l1, _) in looks]
        much = len(shares) == LOADS and median(shares) > OVERLOAD
        text = wording.overload(lost - lost_0, due - due_0, causes - causes_0)
        self.alarms.put("overload", "loop", text if much else "")

    def _has_run_s(self) -> float:
        """Seconds of samples in this run."""
        if self._core.samples and self._first_s is None:
            self._first_s = self._core.newest_s
        return abs(self._core.newest_s - self._first_s) if self._first_s is not None else 0.0

    def _hear_request(self) -> None:
        """What `rtid accept` has left; why it cannot be taken is told once."""
        deaf = ""
        try:
            if (request := taken(self._facts.folder)) is not None:
                self._accept(request)
        except OSError as error:
            deaf = str(error)
        if deaf and deaf != self._deaf:
            logger.warning("no request can be taken: %s", deaf)
        self._deaf = deaf

    def _accept(self, request: Acceptance) -> None:
        """The changed machine is the new normal: learn anew from what came since the change."""
        estimator = self._core.learner.estimator
        if not self.plant.changed or estimator.history is None:
            logger.warning("nothing to accept: the machine does what the map says")
            return
        logger.info("accepted by=%s reason=%r", request.who, request.reason)
        chunk = newest(estimator.history, self._core.newest_s - self.plant.since_s)
        self._analyst.put(jobs.Relearn(chunk, estimator.origin_us, request))

    def _why_not_saved(self) -> str:
        return self._saving.why_not(self._core.samples > 0 and self._core.learner.learns)

    def _store(self) -> st.Store:
        why, dropped = self._why_not_saved(), self._analyst.dropped
        return self._saving.store(why, self._facts.restored, self._recording, dropped)

    def _make_status(self) -> st.Status:
        surprise, advice = self.plant.surprise, self._coaching.advice
        return self.teller.tell(self.alarms, self._store(), surprise, self._diagnosing, advice)

    def _judge_signals(self, before: st.Status) -> None:
        """Alarms of messages and signals: what holds for two seconds, but not while all begins."""
        now = self.status
        if self._core.source.is_over or now.now_unix_s - now.started_unix_s < BEGINS_S:
            return
        verdicts = {message.name: message.verdict for message in before.messages}
        lasting = [m for m in now.messages if verdicts.get(m.name) == m.verdict]
        for verdict in wording.MESSAGES:
            self.alarms.put(f"message_{verdict}", "bus", wording.message(verdict, lasting))
        self.alarms.put("signal_range", "sensor", wording.signals(now.signals))

    def _told(self, alarm: st.Alarm) -> None:
        begins = alarm.is_on
        logger.log(30 if begins else 20, "alarm %s name=%s kind=%s text=%r",
                   "on" if begins else "over", alarm.name, alarm.kind, alarm.text)  # fmt: skip
        self._analyst.put(jobs.Note(alarm, keep=begins and alarm.kind != "loop"))

    def _tell_news(self) -> None:
        """An alarm that has just begun or ended, or a snapshot, is told at once."""
        now_s, store, self._is_news = time.time(), self._store(), False
        self.status = replace(self.status, now_unix_s=now_s, alarms=self.alarms.all, store=store)
        self._write_status()

    def _tell(self) -> None:
        """Status, file, log line."""
        before, self.status = self.status, self._make_status()
        self._judge_signals(before)
        if time.monotonic() - self._told_s >= self._facts.log_every_s - 0.5:
            self._told_s = time.monotonic()
            logger.info("status %s", line(self.status))
        if not self._is_ready and self._core.samples:
            self._is_ready = True
            self._core.notifier.tell("READY=1", "STATUS=learning")
        self._write_status()

    def _write_status(self) -> None:
        try:
            st.write(self._facts.folder, self.status)
        except OSError as error:
            self._saving.refused["status"] = str(error)
        else:
            self._saving.refused.pop("status", None)
