"""Every effect whose column is known once the map is, by what it acts on."""

from __future__ import annotations

from collections.abc import Iterator

from rtid.diagnose.candidates import Candidate, Cause
from rtid.diagnose.causes.leaks import leaks, seats
from rtid.diagnose.causes.lines import lines
from rtid.diagnose.causes.openings import openings
from rtid.diagnose.causes.own import own
from rtid.diagnose.causes.sensors import drift, sensors
from rtid.diagnose.causes.storage import SEED, add_echoes, storage, total_softness
from rtid.diagnose.causes.supply import supply
from rtid.diagnose.view import View

__all__ = ["SEED", "add_echoes", "cause_of", "causes", "total_softness"]

MAKERS = (leaks, seats, openings, storage, lines, supply, drift, sensors, own)


def causes(view: View) -> list[Cause]:
    """The causes that this machine and record have columns for; none without all pressures."""
    return list(_causes(view))


def cause_of(view: View, effect: Candidate) -> Cause:
    """The cause that made a candidate."""
    return next(cause for cause in _causes(view) if cause.makes(effect))


def _causes(view: View) -> Iterator[Cause]:
    for make in MAKERS if view.has_pressures else ():
        yield from make(view)
