"""Textbook columns of the 14 effects, for methods that choose among columns: "the right library".

Columns are made of a record's signals and of a map that was fitted without effects (delays and lags
need its slope).
Effects whose columns are the same to first order share one, and are named together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.missing.front import Front, smooth
from benchmarks.missing.linear import LinearMap
from rtid.plain import FloatArray

ATMOSPHERE_PA = 1e5
OPENINGS = (0.4, 0.55, 0.7, 0.85)  # quantiles of a pressure at which a relief valve may open
SLOPE_V, SLOPE_PA = 0.02, 1e4  # by which a point is moved to see the map's slope
TURN_VPS = 0.5  # of a command that reverses


@dataclass(frozen=True)
class Suspect:
    """An effect, or several that look alike: per unit, flow into the chambers (n, c), m3/s.

    softness (n, c), m3/Pa: it acts by storing softness dP/dt instead, and column is that.
    """

    names: frozenset[str]
    column: FloatArray
    softness: FloatArray | None = None


@dataclass(frozen=True)
class Library:
    """All suspects, of any record; what they need is taken from the one that teaches.

    opening_pa (c, openings): of relief valves; start_s: when a drift begins.
    """

    linear: LinearMap
    opening_pa: FloatArray
    start_s: float

    @classmethod
    def of(cls, front: Front, linear: LinearMap) -> Library:
        """The library that a training record asks for."""
        opening = np.quantile(front.samples.p_pa, OPENINGS, axis=0).T
        return cls(linear, opening, float(front.record.t_s[0]))

    def suspects(self, front: Front) -> list[Suspect]:
        """Their columns on a record, always in the same order."""
        return [*_past_the_valves(front), *self._at_an_opening(front), *_stored(front),
                *self._through_the_map(front)]  # fmt: skip

    def _at_an_opening(self, front: Front) -> Iterator[Suspect]:
        p = front.samples.p_pa
        for c, openings in enumerate(self.opening_pa):
            for opening_pa in openings:
                yield _named("relief_valve", _only(c, -np.maximum(p[:, c] - opening_pa, 0.0)))

    def _through_the_map(self, front: Front) -> Iterator[Suspect]:
        """What acts through the valves: edges' flows and their slopes."""
        s, dt_s, linear = front.samples, front.dt_s, self.linear
        flows, w_rate = linear.flows(s), smooth(s.w_v, dt_s, 1)
        slopes = _slopes(front, linear, SLOPE_V, 0.0) / SLOPE_V
        of_drop = _slopes(front, linear, 0.0, SLOPE_PA) / SLOPE_PA
        late = s.into(-slopes * w_rate)
        yield Suspect(frozenset({"input_delay", "spool_lag_second_order"}), late)
        yield _named("spool_lag_second_order", s.into(-slopes * smooth(s.w_v, dt_s, 2)))
        yield _named("valve_hysteresis", s.into(-slopes * np.tanh(w_rate / TURN_VPS)))
        yield _named("valve_gain_drift", s.into(flows * (s.t_s - self.start_s)[:, None]))
        yield _named("line_dynamics", s.into(-of_drop * smooth(flows, dt_s, 1)))
        fed = np.array([e.source == "p_supply" for e in s.machine.edges], float)
        drawn = (flows * fed).sum(axis=1)
        yield _named("supply_sag", s.into(-of_drop * fed * drawn[:, None]))
        for e in range(flows.shape[1]):
            seat = np.zeros_like(flows)
            seat[:, e] = np.where(s.open(e), 0.0, s.root[:, e])
            yield _named("valve_seat_leakage", s.into(seat))


def _named(name: str, column: FloatArray, softness: FloatArray | None = None) -> Suspect:
    return Suspect(frozenset({name}), column, softness)


def _only(chamber: int, values: FloatArray) -> FloatArray:
    """Columns (n, 2) that are zero in the other chamber."""
    column = np.zeros((len(values), 2))
    column[:, chamber] = values
    return column


def _past_the_valves(front: Front) -> Iterator[Suspect]:
    p_a, p_b = front.samples.p_pa.T
    between, p_tank = p_a - p_b, front.record.column("p_tank")
    root = np.sign(between) * np.sqrt(np.abs(between))
    yield _named("internal_leakage_laminar", np.stack([-between, between], axis=1))
    yield _named("internal_leakage_turbulent", np.stack([-root, root], axis=1))
    for c, p in enumerate((p_a, p_b)):
        yield _named("external_leakage_laminar", _only(c, p_tank - p))


def _stored(front: Front) -> Iterator[Suspect]:
    s = front.samples
    rate = smooth(s.p_pa, front.dt_s, 1)
    for c in range(2):
        soft = _only(c, np.ones(len(rate)))
        yield Suspect(frozenset({"extra_dead_volume", "hose_compliance"}), -soft * rate, soft)
    air = s.volume * ATMOSPHERE_PA / s.p_pa**2
    yield _named("entrained_air", -air * rate, air)


def _slopes(front: Front, linear: LinearMap, more_v: float, more_pa: float) -> FloatArray:
    """What the flows (n, e) gain by a little more command or drop, m3/s."""
    s, gained = front.samples, np.zeros(front.samples.w_v.shape)
    for e, edge in enumerate(s.machine.edges):
        i = s.open(e)
        w, dp = s.w_v[i, e], s.dp_pa[i, e]
        more = linear.flow(edge.name, w + more_v, dp + more_pa)
        gained[i, e] = more - linear.flow(edge.name, w, dp)
    return gained
