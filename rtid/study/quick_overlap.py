"""Valves that open within the band in which motion alone takes them for shut.

Of a spool with an underlap all four edges stand open at rest, and of valves of which one opens
before the other nothing moves yet.  Where a record does not match it is asked whether it is
likelier with maps that begin below the band (`rtid.diagnose.overlap`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.diagnose.overlap import SHARE, likeliest_opening
from rtid.study.quick_command import At, Reading, is_taken, said_of
from rtid.study.quick_machine import MachineSizes, of_band


def opening_below(machine: MachineSizes, steps: int) -> MachineSizes:
    """The machine with valves that open so many steps of its grid below its band."""
    u = machine.u_grid
    step = SHARE * float(u[-1] - u[0])
    more = float(u[0]) - step * np.arange(steps, 0, -1)
    band, unit = float(more[0]), machine.command_unit
    before = of_band(machine.safe_band or 0.0, unit)
    assumed = of_band(band, unit, "as what they pass below says")
    assumptions = (*(a for a in machine.assumptions if a != before), assumed)
    grid = np.concatenate([more, u])
    return replace(machine, u_grid=grid, safe_band=band, assumptions=assumptions)


def below_its_band(first: Reading, at: At) -> Reading:
    """The record with maps that begin below the band, where that makes it likelier.

    What was named with a band in which valves are open is void, even where the record then tells
    too little for a verdict: maps that stand open at rest share what flows there.
    """
    opening = likeliest_opening(first.study.diagnosed.result.last)
    if opening is None or not opening.is_likelier:
        return first
    machine = opening_below(first.machine, opening.steps)
    study = at(machine)
    said = said_of(study)
    leaves_less = said.rho_after <= max(1.0, first.said.rho_after)
    is_better = leaves_less or is_taken(said, first.said)
    return Reading(study, machine, said) if is_better else first
