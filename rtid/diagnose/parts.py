"""What a project has added to its model, in plain values, and back to a revision.

A part names its effect, its place and the parameters that it was found with.  Shapes and timings
are taken from it as they are; coefficients are fitted anew to every record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rtid.diagnose.commands import behind, transformed
from rtid.diagnose.fit import first_map
from rtid.diagnose.revision import Revision
from rtid.effects.column import Candidate, Cause
from rtid.effects.laws import causes
from rtid.effects.laws.pump import PUMP
from rtid.effects.laws.sensors import sensor_timings
from rtid.effects.laws.timing import COMMAND, Psi, TimingLaw, timings_of
from rtid.effects.page import Effect
from rtid.effects.record_view import RecordView
from rtid.errors import RtidError
from rtid.estimator.state import Weights
from rtid.model import Machine
from rtid.plain import FloatArray


class PartError(RtidError):
    """An effect of the project that this record has no column for."""


@dataclass(frozen=True)
class AddedEffect:
    """One effect that was added; parameters: name -> SI value; own_spools: as of `TimingLaw`."""

    effect: str
    where: str
    parameters: Mapping[str, float]
    own_spools: bool = False

    @property
    def key(self) -> tuple[str, str]:
        """As of a candidate."""
        return self.effect, self.where


def recall(
    model: Machine,
    chunk: FloatArray,
    weights: Weights,
    parts: tuple[AddedEffect, ...],
    suspects: tuple[Effect, ...] = (),
) -> Revision:
    """The revision with these parts on a record, chunk (n, 2 + signals), SI.

    suspects: effects of the user's beside those of the catalogue.

    Raises PartError where a part fits no effect of this machine and record.
    """
    known = (*timings_of(model, chunk), PUMP, *sensor_timings(model))
    told = [(part, _timing(part, known)) for part in parts]
    timings = tuple(timing for _, timing in told if timing is not None)
    fixed = [part for part, timing in told if timing is None]
    if not fixed:
        return Revision((), timings)
    sent = transformed(model, chunk, timings, weights.compliance)
    whole = behind(model, timings)
    view = RecordView.of(whole, sent, weights, first_map(whole, sent, weights))
    offered = causes(view, suspects)
    return Revision(tuple(_candidate(p, offered) for p in fixed), timings)


def _timing(part: AddedEffect, known: tuple[TimingLaw, ...]) -> tuple[TimingLaw, Psi] | None:
    fit = [t for t in known if t.is_at(*part.key) and t.own_spools == part.own_spools]
    if fit:  # where several have its name, the one with its parameters
        timing = min(fit, key=lambda t: set(t.parameters) != set(part.parameters))
        return timing, tuple(_value(part, name) for name in timing.parameters)
    if part.where == COMMAND:
        raise _unfit(part, "is no effect on a command")
    return None


def _candidate(part: AddedEffect, offered: list[Cause]) -> Candidate:
    for cause in offered:
        candidate = cause.candidate
        first = candidate.shape_names[0] if candidate.is_whole else candidate.parameter
        if candidate.key == part.key and first in part.parameters:
            names = zip(candidate.shape_names, cause.axes, strict=True)
            return cause.at(tuple(_value(part, name, axis[0]) for name, axis in names))
    raise _unfit(part, "cannot act in this record")


def _value(part: AddedEffect, name: str, usual: float = 1.0) -> float:
    """A parameter of a part; one that is usually zero may be left out."""
    if name not in part.parameters and usual == 0.0:
        return 0.0
    if name not in part.parameters:
        raise _unfit(part, f"has no parameter {name}")
    return part.parameters[name]


def _unfit(part: AddedEffect, problem: str) -> PartError:
    return PartError(
        f"the project has added {part.effect} at {part.where}, which {problem}",
        f"rtid drop {part.effect}, or correct [[added]] in the project file",
    )
