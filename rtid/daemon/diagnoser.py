"""The helper that diagnoses, checks and coaches: one process per job, whose memory goes with it.

`python -m rtid.daemon.diagnoser FD PROJECT`: one job in, one answer out.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace
from pathlib import Path

from firmware_bridge.sources.errors import LogError
from rtid.daemon.advice import advise
from rtid.daemon.jobs import Answer, Check, Checked, Coach, Coached, Diagnose, Job, VerdictAnswer
from rtid.daemon.pipe import Pipe
from rtid.daemon.status import Verdict
from rtid.effects import catalogue
from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.model import Upkeep
from rtid.project import Project, load
from rtid.study.spans import added_parts
from rtid.study.study import diagnose_live
from rtid.tell.diagnosed import sentences
from rtid.trace.check import judge_recording
from rtid.trace.signals import read_recording

NICE = 5


def diagnose(job: Diagnose, project: Project) -> VerdictAnswer:
    """The verdict on these samples, or why there is none."""
    span_s = float(job.chunk[-1, 0] - job.chunk[0, 0]) if len(job.chunk) else 0.0
    now_s = time.time()
    upkeep = Upkeep(history_s=span_s + 1.0, history_rows_per_s=len(job.chunk) / (span_s + 1.0) + 1)
    estimator = Estimator(replace(job.model, upkeep=upkeep))
    assert estimator.history is not None
    estimator.history.append(job.chunk)
    diagnosis = diagnose_live(estimator, added_parts(project), project.effects)
    effects = tuple(f"{e.effect} ({e.where})" if e.where else e.effect for e in diagnosis.found)
    text = " ".join(sentences(diagnosis)[:3])
    pages = catalogue()
    places = [pages[e.effect].places for e in diagnosis.found if e.effect in pages]
    of_sensor = bool(diagnosis.found) and all("sensor" in place for place in places)
    told, is_sensor = diagnosis.as_json(), of_sensor and bool(places)
    span = span_s, 0.0
    return VerdictAnswer(Verdict(now_s, diagnosis.verdict, text, effects, span, told, is_sensor))


def check(job: Check, project: Project) -> Checked:
    """What `rtid check` has against the project file, by the daemon's own recording."""
    report = judge_recording(project, read_recording(project, Path(job.recording)))
    errors = [finding for finding in report.findings if finding.level == "error"]
    return Checked(tuple(f"{finding.subject}: {finding.text}" for finding in errors))


def main() -> None:
    """Serve the daemon at the other end of the pipe."""
    fd, path = sys.argv[1:]
    os.nice(NICE)
    pipe, project = Pipe(int(fd)), load(path)
    try:
        while (job := pipe.receive()) is not None:
            pipe.send(answer(job, project))
    except (EOFError, OSError):
        pass  # the daemon is gone


def answer(job: Job, project: Project) -> Answer:
    """Do one job."""
    try:
        if isinstance(job, Check):
            return check(job, project)
        if isinstance(job, Coach):
            return Coached(advise(project, Path(job.snapshot), job.chunk))
        assert isinstance(job, Diagnose)
        return diagnose(job, project)
    except (RtidError, LogError, OSError) as error:  # OSError: the file has just been set aside
        reason = str(error)
        return Coached(None, reason) if isinstance(job, Coach) else VerdictAnswer(None, reason)


if __name__ == "__main__":
    main()
