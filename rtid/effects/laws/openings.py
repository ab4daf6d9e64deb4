"""Valves that open at a pressure: a poppet with its own time constant and hysteresis.

Q = K max(0, P* - P_r),  P* the pressure behind a play of the width of the hysteresis
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rtid.effects.column import Cause, of_page
from rtid.effects.law import Shape, Volumes, lagged
from rtid.effects.laws.timing import played
from rtid.effects.page import Effect, catalogue
from rtid.effects.record_view import RecordView
from rtid.plain import Key

POPPET_OUT = "poppet_out"  # as a page names the law
OPENINGS = 8  # opening pressures that are tried, over the range
OWN_TIMES_S = (0.0, 0.02, 0.06)
SHUT, RARE = 0.1, 0.998  # quantiles of the pressure: one that never shuts is a leak
MAKEUP_PA = 6e6  # a make-up valve feeds from the tank line, or from a charge line of some MPa
HYSTERESIS = 0.04  # of the highest pressure: where the search begins


def poppets_at(where: str) -> set[Key]:
    """The effects of the catalogue that let out above an opening pressure, at a place."""
    return {(page.name, where) for page in _poppets()}


def leaks_at(where: str) -> set[Key]:
    """What a poppet is that never shuts, at a place: a flow in proportion to the pressure."""
    sizes = {(page.size.unit, name) for page in _poppets() for name in page.confounders}
    pages = catalogue().values()
    return {(p.name, where) for p in pages if p.spills and (p.size.unit, p.name) in sizes}


def _poppets() -> list[Effect]:
    return [page for page in catalogue().values() if page.law == POPPET_OUT]


def opening(view: RecordView, effect: Effect, sign: float) -> Iterator[Cause]:
    """On each chamber, a valve that lets out (sign +1) above its opening pressure, or in below."""
    for c in range(len(view.model.chambers)):
        yield _opening(view, effect, c, sign)


def _opening(view: RecordView, effect: Effect, c: int, sign: float) -> Cause:
    p, smooth = view.pressure(c), view.smooth(view.pressure(c))
    shares = (SHUT, RARE) if sign > 0 else (1.0 - RARE, 1.0 - SHUT)
    low, high = (float(v) for v in np.quantile(p, shares))
    is_possible = sign > 0 or low < MAKEUP_PA
    if sign < 0 and is_possible:
        high = min(high, MAKEUP_PA)
    pressures = tuple(float(v) for v in np.linspace(low, high, OPENINGS + 2)[1:-1])
    # one that was open for 97 % of a record ended at the first of these, and two leaks mended that
    ends = (float(smooth.min()), float(smooth.max() if sign > 0 else high))

    def make(shape: Shape) -> Volumes:
        opening, own_time_s, hysteresis = shape
        # a play follows extremes: those of the noise would widen it
        poppet = played(smooth, view.step_s, (hysteresis,)) if hysteresis > 0.0 else p
        flow = -sign * np.maximum(0.0, sign * (poppet - opening))
        return {c: view.over_intervals(lagged(flow, view.step_s, own_time_s))}

    shape_names = ("opening_pressure", "own_time_constant", "hysteresis")
    candidate = of_page(effect, view.model.chambers[c].name, shape=shape_names)
    times_s = OWN_TIMES_S if sign > 0 else (0.0,)  # a check valve is quick
    axes = pressures, times_s, (0.0, HYSTERESIS * high)
    return Cause(candidate, make, axes, 2, is_possible, (ends,))
