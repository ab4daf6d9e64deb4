"""The manufacturer's map: one rated flow for all valves, an orifice above a nominal dead band.

Nothing is learned: the map of the data sheet and the declared bulk modulus, as machines run today.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.missing.front import Front
from benchmarks.missing.record import Flow, Learned, Record
from rtid.plain import FloatArray

NOMINAL_BAND_V, RATED_V = 1.8, 4.0  # rated_q_m3s is the flow of so much beyond the dead band


def sheet_flow(record: Record) -> Flow:
    """Q(edge, w_v, dp_pa) of the data sheet, m3/s."""
    edges = {e.name: e for e in record.machine.edges}

    def flow(edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        e, w, dp = edges[edge], np.asarray(w_v, float), np.asarray(dp_pa, float)
        open_ = np.maximum(w - NOMINAL_BAND_V, 0.0) / RATED_V
        return np.asarray(e.rated_q_m3s * open_ * np.sign(dp) * np.sqrt(np.abs(dp) / e.rated_dp_pa))

    return flow


def predicted(record: Record, flow: Flow, beta_pa: FloatArray) -> FloatArray:
    """dP/dt (n, c), Pa/s, by maps of all edges; nothing passes within the safe band."""
    at = Front(record).samples
    flows = np.zeros(at.w_v.shape)
    for k, edge in enumerate(at.machine.edges):
        i = at.open(k)
        flows[i, k] = flow(edge.name, at.w_v[i, k], at.dp_pa[i, k])
    return at.rates(at.into(flows), beta_pa)


class DataSheet:
    """The baseline that everything has to beat."""

    def name(self) -> str:
        """Its row."""
        return "data sheet"

    def learn(self, train: Record) -> Learned:
        """Nothing but what is declared."""
        beta = np.full(len(train.machine.chambers), train.machine.beta_nominal_pa)
        flow = sheet_flow(train)
        return Learned(lambda test: predicted(test, flow, beta), flow, None, beta)


METHODS = (DataSheet(),)
