"""Diagnose a captured trace: from project file and log to what is missing in the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rtid.diagnose.diagnosis import Result, search
from rtid.diagnose.parts import Part
from rtid.diagnose.report import Diagnosis, diagnosis
from rtid.effects import UserEffect
from rtid.estimator.estimator import Estimator, to_chunk
from rtid.model import FloatArray, Model
from rtid.project import Project
from rtid.replay import NoSamplesError, Trace, model_for, read_trace, replay

MIN_LIVE_S = 10.0
HELD_OUT_SHARE = 0.25  # of a record without declared parts: its end


@dataclass(frozen=True)
class Diagnosed:
    """A diagnosed trace: the search with every fit, and what is said of it."""

    project: Project
    model: Model
    trace: Trace
    result: Result
    diagnosis: Diagnosis


def _silent(_what: str, _share: float) -> None:
    pass


def diagnose_trace(
    project: Project, path: Path, progress: Callable[[str, float], None] = _silent
) -> Diagnosed:
    """Diagnose one trace.  Raises NoSamplesError where there is nothing to learn from."""
    progress("reading", 0.0)
    trace = trace_of(project, path)
    model = replace(model_for(project, trace.samples), own_effects=project.effects)
    identification, held_out = parts(project, model, trace)
    result = search(model, identification, held_out, progress, added_parts(project))
    progress("done", 1.0)
    return Diagnosed(project, model, trace, result, diagnosis(result))


def trace_of(project: Project, path: Path) -> Trace:
    """The samples of a trace, at the message ages that it shows where nobody has declared them."""
    return replay(project, path).trace if project.offset_tolerance_s else read_trace(project, path)


def diagnose_live(
    estimator: Estimator, more: tuple[Part, ...] = (), own_effects: tuple[UserEffect, ...] = ()
) -> Diagnosis:
    """What is missing in a running estimator's model, by the samples in its ring buffer.

    The newest quarter is held out.  The estimator is not changed, and may go on in its thread: the
    samples are copied first.  Raises NoSamplesError without a ring buffer ([upkeep] history_s), or
    where it holds less than MIN_LIVE_S.
    """
    history = estimator.history
    chunk = history.chunk() if history is not None else np.zeros((0, 2))
    held_s = chunk[-1, 0] - chunk[0, 0] if len(chunk) else 0.0
    if held_s < MIN_LIVE_S:
        raise NoSamplesError(
            f"{held_s:.1f} s of samples are kept, a diagnosis needs {MIN_LIVE_S:g} s",
            "set upkeep.history_s in the project file, 120 for instance, and let the machine move",
        )
    held_out = chunk[:, 0] >= chunk[-1, 0] - HELD_OUT_SHARE * held_s
    model = replace(estimator.model, own_effects=own_effects)
    return diagnosis(search(model, chunk[~held_out], chunk[held_out], parts=more))


def added_parts(project: Project) -> tuple[Part, ...]:
    """The effects that the project has added, in the order of addition."""
    return tuple(
        Part(a.effect, a.where, {n: p.value for n, p in a.parameters.items()}, a.own_spools)
        for a in project.sections.added
    )


def parts(project: Project, model: Model, trace: Trace) -> tuple[FloatArray, FloatArray]:
    """Identification and held-out part, chunks (n, 2 + signals); by default the end is held out."""
    chunk = to_chunk(model, trace.samples, int(trace.samples.t_us[0]))
    t_s, record = chunk[:, 0], project.sections.record
    split = t_s[0] + (1.0 - HELD_OUT_SHARE) * (t_s[-1] - t_s[0])
    learn = record.identification_s or (0.0, split)
    test = record.validation_s or (split, float("inf"))
    found = [chunk[(t_s >= low) & (t_s < high)] for low, high in (learn, test)]
    for part, name in zip(found, ("identification", "validation"), strict=True):
        if len(part) < 2:
            raise NoSamplesError(
                f"{trace.path}: no samples in the {name} part", "adapt [record] in the project file"
            )
    return found[0], found[1]
