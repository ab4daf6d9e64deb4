"""Which motion would show more: detection limits of this record, had its supply been varied.

A chamber that is fed follows its supply: at the same motion and commands the pressure drops stay
what they were, and P_c = p_s - dp moves with p_s.  That is what a constant supply hides, where any
function of P_c is one of dp.  So the record is rewritten with a wandering supply, every column is
made anew, and the standard deviations follow without simulating a machine.
"""

from __future__ import annotations

import numpy as np

from rtid.diagnose.candidates import Candidate
from rtid.diagnose.fit import Fit, one_pass
from rtid.diagnose.regression import LIMIT_SD
from rtid.model import FloatArray

SWING, RATES_HZ = 0.2, (0.03, 0.11)  # of the supply
SETTLE_S = 0.05  # within which a chamber that is fed anew takes up its supply

Limits = dict[Candidate, tuple[float, float]]


def varied_supply(fit: Fit) -> FloatArray | None:
    """The record of a fit with a wandering supply; None where no edge names one."""
    view, declared = fit.view, fit.declared
    if not view.supply_name:
        return None
    chunk = fit.sent[:, : 2 + len(declared.signals)].copy()
    supply = 2 + declared.column(view.supply_name)
    t_s = chunk[:, 0] - chunk[0, 0]
    wander = sum(np.sin(2 * np.pi * rate * t_s) for rate in RATES_HZ) / len(RATES_HZ)
    rise = SWING * np.median(chunk[:, supply]) * wander
    chunk[:, supply] += rise
    for chamber in declared.chambers:
        fed = np.zeros(view.n)
        for i, edge in enumerate(declared.edges):
            if edge.source == view.supply_name and edge.sign(chamber) > 0:
                fed[:-1] = np.maximum(fed[:-1], view.flow(i) > 0.0)
        share = view.smooth_steps(fed, SETTLE_S)
        chunk[:, 2 + declared.column(chamber.pressure)] += share * rise
    return chunk


def limits(fit: Fit) -> Limits:
    """Detection limits as recorded, and with a wandering supply, for every candidate."""
    chunk = varied_supply(fit)
    if chunk is None or not fit.columns.candidates:
        return {}
    other = one_pass(fit.declared, chunk, fit.weights, fit.revision, fit.map, bank=True)
    found: Limits = {}
    for k, candidate in enumerate(fit.columns.candidates):
        if candidate in fit.revision.effects or candidate not in other.columns.candidates:
            continue
        before = fit.regression.score(fit.estimate.used, fit.first + k).sd
        column = other.first + other.columns.candidates.index(candidate)
        after = other.regression.score(other.estimate.used, column).sd
        found[candidate] = LIMIT_SD * before, LIMIT_SD * after
    return found
