"""What of a trace teaches and what judges, and the effects that its project has added."""

from __future__ import annotations

from rtid.diagnose.parts import AddedEffect
from rtid.effects import catalogue
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.project import Project
from rtid.study.kept_record import within
from rtid.trace.neutral import last_part_from
from rtid.trace.reading import NoSamplesError, Trace

HELD_OUT_SHARE = 0.25  # of a record without declared parts: its end


def added_parts(project: Project) -> tuple[AddedEffect, ...]:
    """The effects that the project has added, in the order of addition.

    NotTrustedError where one of them may be in Python that is not run.
    """
    known = {*catalogue(), *(effect.name for effect in project.effects)}
    if any(a.effect not in known for a in project.sections.parts):
        _ = project.all_effects
    return tuple(
        AddedEffect(a.effect, a.where, {n: p.value for n, p in a.parameters.items()}, a.own_spools)
        for a in project.sections.parts
    )


def taught(project: Project, model: Machine, trace: Trace) -> FloatArray:
    """The part that teaches, chunk (n, 2 + signals), SI: as declared, else all but the end."""
    chunk, split = _whole(model, trace)
    span_s = project.sections.record.identification_s or (0.0, split)
    return _part(trace, chunk, span_s, "identification")


def judged(project: Project, model: Machine, trace: Trace) -> FloatArray:
    """The part that judges, chunk (n, 2 + signals), SI: as declared, else the end."""
    chunk, split = _whole(model, trace)
    span_s = project.sections.record.validation_s or (split, float("inf"))
    return _part(trace, chunk, span_s, "validation")


def parts(project: Project, model: Machine, trace: Trace) -> tuple[FloatArray, FloatArray]:
    """Identification and held-out part, chunks (n, 2 + signals), SI; else the end is held out."""
    return taught(project, model, trace), judged(project, model, trace)


def _whole(model: Machine, trace: Trace) -> tuple[FloatArray, float]:
    """All samples, and when the last quarter begins, of the motion where the machine rests then."""
    chunk = trace.chunk(model)
    x = chunk[:, 2 + model.column(model.position)]
    return chunk, last_part_from(chunk[:, 0], x, HELD_OUT_SHARE)


def _part(trace: Trace, chunk: FloatArray, span_s: tuple[float, float], name: str) -> FloatArray:
    part = within(chunk, span_s)
    if len(part) < 2:
        raise NoSamplesError(
            f"{trace.path}: no samples in the {name} part", "adapt [record] in the project file"
        )
    return part
