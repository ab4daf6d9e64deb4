"""Several records as one trace: each begins anew, and those that judge stand behind the others.

    [record]
    records = ["day1.csv", "day2.csv"]     # learned from as well, relative to the project file
    held_out = ["day2*"]                   # by name: these judge, as a whole

Times count on from record to record, with a gap between two: the estimator starts again there, and
a neutral that is to be found is found in each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

from firmware_bridge.frames import add_counts
from firmware_bridge.samples import GAP, join
from rtid.errors import RtidError
from rtid.estimator.noise import NoiseEstimate, pooled
from rtid.plain import BoolArray, FloatArray
from rtid.project import Project
from rtid.trace.reading import Trace, read_trace

TracePaths = str | Path | Sequence[str | Path]
BETWEEN_S = 10.0  # longer than any step within a record


@dataclass(frozen=True)
class RecordSpan:
    """One record of several: file, and when it begins and ends in the trace of all, s."""

    path: Path
    start_s: float
    end_s: float
    is_held_out: bool


def records_of(project: Project, given: TracePaths) -> tuple[Path, ...]:
    """The records given and those of the project, once each, those held out last.

    Where no project says which, the last of several given ones is held out.  RtidError for none at
    all, for nothing to learn from, and for a name to hold out that no record has.
    """
    section = project.sections.record
    named = [Path(given)] if isinstance(given, str | Path) else [Path(path) for path in given]
    named += [project.path.parent / name for name in section.records]
    paths = tuple({path.resolve(): path for path in named}.values())
    if not paths:
        raise RtidError("no record is named", "give one, or records under [record]", 2)
    if len(paths) == 1:
        return paths
    judging = held_out_of(project, paths)
    if section.identification_s or section.validation_s:
        problem = f"{project.path}: [record] cuts one record into parts, and there are {len(paths)}"
        raise RtidError(problem, 'hold whole ones out instead: held_out = ["NAME"]')
    if len(judging) == len(paths):
        raise RtidError("all records are held out: none teaches", "hold fewer of them out")
    return (*(path for path in paths if path not in judging), *judging)


def held_out_of(project: Project, paths: Sequence[Path]) -> list[Path]:
    """Which of several records judge; RtidError for a name that fits none."""
    patterns = project.sections.record.held_out
    for pattern in patterns:
        if not any(_fits(path, pattern) for path in paths):
            there = ", ".join(path.name for path in paths)
            raise RtidError(f"record.held_out: no record is called {pattern!r}", f"name of {there}")
    return [path for path in paths if any(_fits(path, p) for p in patterns)] or [paths[-1]]


def _fits(path: Path, pattern: str) -> bool:
    return fnmatch(path.name, Path(pattern).name)


def read_records(project: Project, paths: Sequence[Path]) -> tuple[Trace, tuple[RecordSpan, ...]]:
    """The records one after the other, and where each of them stands."""
    traces, judging = [read_trace(project, path) for path in paths], held_out_of(project, paths)
    parts, spans, counters = [], list[RecordSpan](), dict[str, int]()
    start_us = 0
    for trace in traces:
        samples = trace.samples
        t_us, flags = samples.t_us - samples.t_us[0] + start_us, samples.flags.copy()
        flags[0] |= GAP
        parts.append(replace(samples, t_us=t_us, flags=flags))
        is_judging = trace.path in judging
        spans.append(RecordSpan(trace.path, 1e-6 * start_us, 1e-6 * float(t_us[-1]), is_judging))
        start_us = int(t_us[-1]) + round(1e6 * BETWEEN_S)
        add_counts(counters, trace.counters)
    noise, every = _noise(traces), [trace.crossed for trace in traces]
    crossed = frozenset().union(*every) & noise.keys()
    return Trace(traces[0].path, join(parts), counters, None, noise, crossed), tuple(spans)


def _noise(traces: Sequence[Trace]) -> dict[str, NoiseEstimate]:
    """The noise of the sensors over all records, which have the same ones."""
    return {
        name: pooled([trace.noise[name] for trace in traces])
        for name in traces[0].noise
        if all(name in trace.noise for trace in traces)
    }


def with_spans(project: Project, spans: Sequence[RecordSpan]) -> Project:
    """The project whose identification part are the records that teach."""
    split_s = next(span.start_s for span in spans if span.is_held_out) - 0.5 * BETWEEN_S
    cut = {"identification_s": (0.0, split_s), "validation_s": (split_s, spans[-1].end_s + 1.0)}
    record = project.sections.record.model_copy(update=cut)
    return replace(project, sections=replace(project.sections, record=record))


def rows_by_record(
    spans: Sequence[RecordSpan], t_s: FloatArray
) -> Iterator[tuple[RecordSpan, BoolArray]]:
    """Which rows, at t_s (rows,) in s of the trace of all, belong to each record that has any."""
    for span in spans:
        here = (t_s >= span.start_s) & (t_s <= span.end_s)
        if here.any():
            yield span, here
