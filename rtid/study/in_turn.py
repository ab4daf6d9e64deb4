"""What is missing from a plant without pressures, one after the other, each in the project.

What moves such a plant beside its command is as large as makes the model's residual noise: a leak
at one port of a pump hides what the other port leaks.  With what was found in the project the rest
is weighed anew, and smaller, and what it hid is seen.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from rtid.diagnose.report import Diagnosis, FoundEffect
from rtid.diagnose.verdict import AMBIGUOUS, INSUFFICIENT, MISSING
from rtid.errors import RtidError
from rtid.study.study import Study

ROUNDS = 3
NAMED = (MISSING, AMBIGUOUS, INSUFFICIENT)


def in_turn(study: Study, is_straight: bool) -> Diagnosis:
    """Diagnose, add what is named, and look again; the project of the study has it then.

    is_straight: of maps that cannot bend.  Beside those of a state's rate the first effect alone is
    added, whose shape the maps may have taken for the rest; beside others nobody looks again.
    """
    said = study.diagnosis()
    takes_all = is_straight or bool(study.project.model.measured)
    new = _added(study, said.found if takes_all else said.found[:1])
    for _ in range(ROUNDS - 1):
        if not (new and is_straight):
            break
        again = study.diagnosis()
        new = _added(study, again.found if again.verdict in NAMED else ())
        said = _both(said, again, new)
    return said


def _added(study: Study, effects: tuple[FoundEffect, ...]) -> tuple[FoundEffect, ...]:
    """Those that the project has now."""
    new = []
    for effect in effects:
        with suppress(RtidError):
            study.add(f"{effect.effect}:{effect.where}", force=True)
            new.append(effect)
    return tuple(new)


def _both(first: Diagnosis, again: Diagnosis, new: tuple[FoundEffect, ...]) -> Diagnosis:
    """The first diagnosis with what a later one has found beside it."""
    if not new:
        return first
    is_set = any(effect.cannot_be_told_from for effect in (*first.found, *new))
    named = AMBIGUOUS if is_set else MISSING
    return replace(
        again,
        verdict=first.verdict if first.verdict == INSUFFICIENT else named,
        added=first.added,
        found=(*first.found, *new),
        rho_before=first.rho_before,
        rho_after=first.rho_after * again.rho_after / max(again.rho_before, 1e-12),
        heldout_residual_before_m3s=first.heldout_residual_before_m3s,
        doubts=first.doubts,
        cut=first.cut,
        disturbance=first.disturbance,
    )
