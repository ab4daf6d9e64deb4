"""Which motion would show more: detection limits of this record, had its supply been varied.

Under the same load and motion the pressures of the chambers stay what they were; the drop over a
valve that feeds one moves with the supply, and the controller moves the command so that the flow
stays:  du = - (dQ/ddp / dQ/du) dp_s.  That is what a constant supply hides, where any function of
P_c = p_s - dp is one of dp.  So the record is rewritten with a wandering supply, every column is
made anew, and the standard deviations follow without simulating a machine.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from rtid.diagnose.fit import Fit, one_pass
from rtid.diagnose.regression import Score
from rtid.effects.column import Candidate
from rtid.effects.laws.timing import command_times
from rtid.plain import FloatArray, Key

SWING, RATES_HZ = 0.2, (0.03, 0.11)  # of the supply
STEEP = 0.05  # of the largest dQ/du: a command that hardly opens its valve is left alone
MOST = 2.0  # that a command of 10 V is moved by, and others by as much of theirs

FLOW = "flow"  # kind of an effect
AT_REST_S = 1.0  # with all valves shut: enough to tell a leak from a map
STEADY = 0.05  # of its mean: a supply that varies less is constant

BothScores = dict[Candidate, tuple[Score, Score]]


def varied_supply(fit: Fit) -> FloatArray | None:
    """The record of a fit, as declared, with a wandering supply: (n, 2 + signals), SI.

    None where no edge names a supply.
    """
    view, declared = fit.view, fit.declared
    if not view.supply_name:
        return None
    chunk = fit.chunk.copy()  # not as sent: a sag that was found lowers it once more in each fit
    supply = 2 + declared.column(view.supply_name)
    t_s = chunk[:, 0] - chunk[0, 0]
    wander = sum(np.sin(2 * np.pi * rate * t_s) for rate in RATES_HZ) / len(RATES_HZ)
    most, rise = MOST * command_times(declared), SWING * np.median(chunk[:, supply]) * wander
    chunk[:, supply] += rise
    for i, edge in enumerate(declared.edges):
        if edge.source == view.supply_name:
            slope = view.slope_u(i)
            steep = slope > STEEP * max(float(slope.max()), 1e-300)
            moved = np.where(steep, -view.slope_dp(i) * rise[:-1], 0.0) / np.where(
                steep, slope, 1.0
            )
            command = 2 + declared.column(edge.command)
            chunk[:-1, command] += edge.direction * np.clip(moved, -most, most)
    return chunk


def foretold(fit: Fit, keys: Collection[Key]) -> BothScores:
    """Scores as recorded, and with a wandering supply, of the candidates of some causes.

    keys: those of the causes.
    """
    chunk = varied_supply(fit)
    if chunk is None or not fit.columns.candidates:
        return {}
    other = one_pass(
        fit.declared, chunk, fit.weights, fit.revision, fit, True, thorough=False,
        suspects=fit.suspects,
    )  # fmt: skip
    both: BothScores = {}
    for k, candidate in enumerate(fit.columns.candidates):
        is_free = candidate.key in keys and candidate not in fit.revision.effects
        if not is_free or candidate not in other.columns.candidates:
            continue
        column = other.first + other.columns.candidates.index(candidate)
        both[candidate] = (
            fit.regression.score(fit.estimate.used, fit.first + k),
            other.regression.score(other.estimate.used, column),
        )
    return both


def would_separate(fit: Fit, kind: str) -> Iterator[str]:
    """Motions that would keep an effect out of the maps, but for those that the record has.

    kind: of its page; only a flow goes on while the valves are shut.
    """
    edges = fit.declared.edges
    if kind == FLOW and not any(edge.safe_band_v > 0.0 for edge in edges):
        yield "declare the command below which each valve is surely shut (safe_band)"
    elif kind == FLOW and _shut_s(fit) < AT_REST_S:
        yield "rest under load for some seconds with all valves shut"
    if fit.view.supply_name:
        supply = fit.view.signal(fit.view.supply_name)
        if float(np.std(supply)) < STEADY * abs(float(np.mean(supply))):
            yield f"vary the supply's pressure by {100 * SWING:.0f} % in the same motion"


def _shut_s(fit: Fit) -> float:
    """How long all valves are surely shut in a record."""
    shut = np.ones(fit.view.n - 1, bool)
    for edge in fit.declared.edges:
        command = edge.direction * fit.chunk[:-1, 2 + fit.declared.column(edge.command)]
        shut &= command <= edge.safe_band_v
    return float(np.sum(fit.view.dt_s[shut]))
