"""What a project has added to its model, in plain values, and back to a revision.

A part names its effect, its place and the parameters that it was found with.  Shapes and timings
are taken from it as they are; coefficients are fitted anew to every record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rtid.diagnose.candidates import Candidate, Cause
from rtid.diagnose.causes import causes
from rtid.diagnose.commands import split, transformed
from rtid.diagnose.fit import Fit, first_map
from rtid.diagnose.pump import PUMP
from rtid.diagnose.revision import Revision
from rtid.diagnose.timing import COMMAND, TIMINGS, Psi, Timing
from rtid.diagnose.view import View
from rtid.errors import RtidError
from rtid.estimator.state import Weights
from rtid.model import FloatArray, Model


class PartError(RtidError):
    """An effect of the project that this record has no column for."""


@dataclass(frozen=True)
class Part:
    """One effect that was added; parameters: name -> SI value; own_spools: as of `Timing`."""

    effect: str
    where: str
    parameters: Mapping[str, float]
    own_spools: bool = False

    @property
    def key(self) -> tuple[str, str]:
        """As of a candidate."""
        return self.effect, self.where


def part_of(fit: Fit, key: tuple[str, str], parameters: Mapping[str, float]) -> Part:
    """The part that a cause of a fit becomes."""
    own = any(t.own_spools for t, _ in fit.revision.timings if t.effect == key[0])
    return Part(*key, parameters, own)


def recall(model: Model, chunk: FloatArray, weights: Weights, parts: tuple[Part, ...]) -> Revision:
    """The revision with these parts on a record, chunk (n, 2 + signals).

    Raises PartError where a part fits no effect of this machine and record.
    """
    timings = tuple((t, psi) for p in parts if (found := _timing(p)) for t, psi in [found])
    fixed = [p for p in parts if _timing(p) is None]
    if not fixed:
        return Revision((), timings)
    sent, whole = transformed(model, chunk, timings), split(model)
    view = View.of(whole, sent, weights, first_map(whole, sent, weights))
    offered = causes(view)
    return Revision(tuple(_candidate(p, offered) for p in fixed), timings)


def _timing(part: Part) -> tuple[Timing, Psi] | None:
    for timing in (*TIMINGS, PUMP):
        if (timing.effect, timing.own_spools) == (part.effect, part.own_spools):
            return timing, tuple(_value(part, name) for name in timing.parameters)
    if part.where == COMMAND:
        raise _unfit(part, "is no effect on a command")
    return None


def _candidate(part: Part, offered: list[Cause]) -> Candidate:
    for cause in offered:
        candidate = cause.candidate
        if candidate.key == part.key and candidate.parameter in part.parameters:
            names = zip(candidate.shape_names, cause.axes, strict=True)
            return cause.at(tuple(_value(part, name, axis[0]) for name, axis in names))
    raise _unfit(part, "cannot act in this record")


def _value(part: Part, name: str, usual: float = 1.0) -> float:
    """A parameter of a part; one that is usually zero may be left out."""
    if name not in part.parameters and usual == 0.0:
        return 0.0
    if name not in part.parameters:
        raise _unfit(part, f"has no parameter {name}")
    return part.parameters[name]


def _unfit(part: Part, problem: str) -> PartError:
    return PartError(
        f"the project has added {part.effect} at {part.where}, which {problem}",
        f"rtid drop {part.effect}, or correct [[added]] in the project file",
    )
