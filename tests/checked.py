"""A changed run as its user has it: a file whose noise is to be estimated, and what check says."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from firmware_bridge.samples import Samples
from rtid.project import load
from rtid.sim.recording import write_run
from rtid.sim.run import Run
from rtid.study.study import Study
from rtid.trace.check import Report, judge
from rtid.trace.signals import read_recording


def checked(run: Run, samples: Samples, folder: Path) -> tuple[Study, Report]:
    """The study of a sweep with other samples, and the report of `rtid check` on it."""
    trace = folder / "run.parquet"
    write_run(trace, replace(run, samples=samples), 0, "sweep")
    file = trace.with_suffix(".toml")
    file.write_text(re.sub(r"(?m)^noise = .*$", 'noise = "estimate"', file.read_text()))
    project = load(file)
    read, stroke_m = read_recording(project, trace), project.sections.stroke_m
    every = (read.samples, read.series, read.messages, read.refused)
    report = judge(project.model, project.table_assembly or project.assembly, *every, stroke_m)
    return Study(file, trace), report
