"""Reference maps: data sheets and calibrations, to be used wherever a learned map is.

    Q = K(|w|) sign(dp) sqrt |dp|,

K between the table's points by linear interpolation; where a table gives Q at several pressure
drops, K = Q / sqrt(dp) may depend on dp too.  Outside the table's commands the flow is not known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from rtid.errors import RtidError
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.orifice import root
from rtid.estimator.published import cell_terms
from rtid.model import Machine
from rtid.plain import FloatArray

ANY_EDGE = "*"


class MissingEdgeError(RtidError):
    """The reference has no map for an edge of the machine."""


@dataclass(frozen=True)
class GainTable:
    """K (n, m) in m3/s/sqrt(Pa) at w_v (n,) and dp_pa (m,), both rising; NaN: not in the table."""

    w_v: FloatArray
    dp_pa: FloatArray
    gain: FloatArray

    def at(self, w_v: FloatArray, dp_pa: FloatArray) -> FloatArray:
        """K (n,) at points (n,) in V, Pa: linear between commands, along |dp| constant beyond."""
        rows = np.stack([self._along_dp(row, np.abs(dp_pa)) for row in self.gain])
        return _between(self.w_v, rows, w_v)

    def flow(self, w_v: FloatArray, dp_pa: FloatArray) -> FloatArray:
        """Q (n,) in m3/s at points (n,) in V, Pa."""
        return self.at(w_v, dp_pa) * root(dp_pa)

    def _along_dp(self, row: FloatArray, dp_pa: FloatArray) -> FloatArray:
        known = np.isfinite(row)
        if not known.any():
            return np.full(len(dp_pa), np.nan)
        return np.interp(dp_pa, self.dp_pa[known], row[known])


@dataclass(frozen=True)
class RateTable:
    """Rates (n, m) of a plant without pressures, SI, at commands w (n,) and over (m,), rising."""

    w: FloatArray
    over: FloatArray
    rate: FloatArray

    def flow(self, w: FloatArray, over: FloatArray) -> FloatArray:
        """Rates (k,), SI, at points (k,) in the table's units; linear, NaN beyond the commands."""
        rows = np.stack([np.interp(over, self.over, row) for row in self.rate])
        return _between(self.w, rows, w)


def _between(known: FloatArray, rows: FloatArray, at: FloatArray) -> FloatArray:
    """Linear between commands (n,) of the rows (n, k) that belong to each of k points, NaN beyond.

    rows: each point's value at every command, in any unit; at: the points' commands (k,).
    """
    k = np.clip(np.searchsorted(known, at) - 1, 0, max(len(known) - 2, 0))
    low, high = rows[k, np.arange(len(k))], rows[k + 1, np.arange(len(k))]
    share = (at - known[k]) / (known[k + 1] - known[k])
    return np.where((at >= known[0]) & (at <= known[-1]), low + share * (high - low), np.nan)


@dataclass(frozen=True)
class ReferenceMap:
    """Tables by edge name, or one for all edges under "*"."""

    name: str
    tables: Mapping[str, GainTable | RateTable]

    def table(self, edge: str) -> GainTable | RateTable:
        """The table of an edge.  Raises MissingEdgeError naming what there is."""
        for key in (edge.casefold(), ANY_EDGE):
            if key in self.tables:
                return self.tables[key]
        known = ", ".join(sorted(self.tables))
        raise MissingEdgeError(
            f"{self.name}: no map for edge {edge!r}, only for {known}",
            "name its columns after the edges of the project, e.g. K_" + edge,
        )

    def flow(self, edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Q in m3/s at broadcast points (...); NaN where the table has nothing."""
        w, dp = np.broadcast_arrays(np.asarray(w_v, float), np.asarray(dp_pa, float))
        return self.table(edge).flow(w.ravel(), dp.ravel()).reshape(w.shape)

    def theta_cells(self, model: Machine) -> FloatArray:
        """Its Taylor terms (cells, 6), m3/s, in all cells of the model's grids, for `explain`."""
        return theta_cells(model, self.flow)


@dataclass(frozen=True)
class LearnedReference:
    """A map that was learned before, as a reference; its grids may differ from the model's."""

    name: str
    flowmap: FlowMap

    def flow(self, edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Q in m3/s at broadcast points (...); NaN off its grid.  Raises MissingEdgeError."""
        known = [e.name for e in self.flowmap.edges]
        if edge not in known:
            text = f"{self.name}: no map for edge {edge!r}, only for {', '.join(known)}"
            raise MissingEdgeError(text, "export it with the project of this machine")
        return self.flowmap.flow(edge, w_v, dp_pa)

    def theta_cells(self, model: Machine) -> FloatArray:
        """Its Taylor terms (cells, 6), m3/s, in all cells of the model's grids."""
        return theta_cells(model, self.flow)


class Reference(Protocol):
    """What both kinds of reference have in common."""

    @property
    def name(self) -> str:
        """What it is called in tables and pictures."""

    def flow(self, edge: str, w_v: ArrayLike, dp_pa: ArrayLike) -> FloatArray:
        """Q in m3/s at points of any one shape (...), V and Pa; NaN where it knows nothing."""

    def theta_cells(self, model: Machine) -> FloatArray:
        """Taylor terms (cells, 6) of all cells of the model's grids, m3/s."""


Flow = Callable[[str, FloatArray, FloatArray], FloatArray]


def theta_cells(model: Machine, flow: Flow) -> FloatArray:
    """Taylor terms (cells, 6), m3/s, of a flow(edge, w, dp) for all cells of the model's grids."""
    parts = []
    for edge in model.maps:

        def of_edge(w: FloatArray, dp: FloatArray, name: str = edge.name) -> FloatArray:
            return flow(name, w, dp)

        parts.append(cell_terms(edge.grid, of_edge))
    return np.concatenate(parts)
