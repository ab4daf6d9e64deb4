"""Every effect whose column is known once the map is, by what it acts on."""

from __future__ import annotations

from rtid.diagnose.candidates import Cause
from rtid.diagnose.causes.leaks import leaks, seats
from rtid.diagnose.causes.lines import lines
from rtid.diagnose.causes.openings import openings
from rtid.diagnose.causes.own import own
from rtid.diagnose.causes.sensors import drift, sensors
from rtid.diagnose.causes.storage import SEED, add_echoes, storage, total_softness
from rtid.diagnose.causes.supply import supply
from rtid.diagnose.view import View

__all__ = ["SEED", "add_echoes", "causes", "total_softness"]

MAKERS = (leaks, seats, openings, storage, lines, supply, drift, sensors, own)


def causes(view: View) -> list[Cause]:
    """The causes that this machine and record have columns for; none without all pressures."""
    if not view.has_pressures:
        return []
    return [cause for make in MAKERS for cause in make(view)]
