"""A record as effects see it: signals by role, volumes, and the flows of the fitted map.

Values at samples have n entries, means and volumes over intervals n - 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rtid.effects.filtering import fitted
from rtid.effects.instants import Instants
from rtid.effects.view import View as Seen
from rtid.estimator.state import Weights, build
from rtid.kernels.following import follow_map
from rtid.kernels.layout import TERMS
from rtid.model import PRESSURE, Edge, Machine
from rtid.plain import BoolArray, FloatArray, IntArray, give_back

TURNS = 0.05  # share of changes that reverse the one before: 2/3 for noise, next to 0 for motion
UNKNOWN = 10.0  # standard deviation of the flow in a block that was never visited, rated flows
NONE = np.zeros(0)
SMOOTH_S = 0.02  # half width of the window for derivatives of pressures, without delay
AT_ONCE = 1 << 14  # intervals that are followed in one go
LONG = 1 << 18  # samples of a record that is read again rather than kept: 4 minutes at 1 kHz
OPENING, FLOW, SLOPE_U, SLOPE_DP, FLOW_SD = range(5)  # what `follow_map` tells of each
ALL_BUT_SD = OPENING, FLOW, SLOPE_U, SLOPE_DP  # of a short record in one go
AT_A_TIME = 2  # of them, of a long record: with one it is followed twice as often


def has_noise(values: FloatArray) -> bool:
    """False for computed values (n,): a measurement turns back at a fair share of its changes.

    Repeats do not count, so that held and interpolated measurements are told as well.
    """
    change = np.diff(values)
    change = change[change != 0.0]
    return len(change) > 2 and bool(np.mean(change[1:] * change[:-1] < 0.0) > TURNS)


def tank_of(model: Machine) -> str:
    """Name of the tank's signal, "" where no edge names one."""
    return min({e.sink for e in model.edges} - {c.pressure for c in model.chambers}, default="")


def supply_of(model: Machine) -> str:
    """Name of the supply's signal, "" where no edge names one."""
    chambers = {chamber.pressure for chamber in model.chambers}
    return next((e.source for e in model.edges if e.source not in chambers), "")


@dataclass(frozen=True)
class MapTerms:
    """Terms (V, 6) of the blocks of the grid cells (V,), in units of the rated flows.

    cov (V, 6, 6): their covariance; empty where nobody asked for it, and deviations are 0 then.
    """

    cells: IntArray
    terms: FloatArray
    cov: FloatArray


@dataclass(frozen=True)
class WithMap:
    """What a record is followed with: weights of the rows, and the map along which it runs."""

    weights: Weights
    map: MapTerms


@dataclass(frozen=True)
class RecordView:
    """chunk (n, 2 + signals); compliance (chambers,) 1/Pa; beside: what it is followed with.

    taught: the record that the map is of, where this is another one.
    """

    model: Machine
    chunk: FloatArray
    compliance: FloatArray
    beside: WithMap | None = None
    taught: RecordView | None = None

    @classmethod
    def of(
        cls,
        model: Machine,
        chunk: FloatArray,
        weights: Weights,
        flowmap: MapTerms,
        taught: RecordView | None = None,
    ) -> RecordView:
        """The record beside a fitted map; chunk (n, 2 + signals), SI."""
        return cls(model, chunk, weights.compliance, WithMap(weights, flowmap), taught)

    @classmethod
    def without_map(
        cls, model: Machine, chunk: FloatArray, compliance: FloatArray = NONE
    ) -> RecordView:
        """The record's signals and volumes alone; chunk (n, 2 + signals), compliance 1/Pa."""
        return cls(model, chunk, compliance)

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.chunk)

    @cached_property
    def t_s(self) -> FloatArray:
        """Instants of the samples (n,)."""
        return np.ascontiguousarray(self.chunk[:, 0])

    @cached_property
    def dt_s(self) -> FloatArray:
        """Lengths of the intervals (n - 1,)."""
        return np.diff(self.t_s)

    @cached_property
    def step_s(self) -> float:
        """The usual length of an interval."""
        return float(np.median(self.dt_s))

    @cached_property
    def instants(self) -> Instants:
        """The instants, with the gaps between them."""
        return Instants.of(self.chunk, self.model.gates.max_gap_s)

    def signal(self, name: str) -> FloatArray:
        """A signal by its name (n,), SI; zero for a quantity that is not there."""
        if name not in self._signals:
            values = self.chunk[:, 2 + self.model.column(name)] if name else np.zeros(self.n)
            self._signals[name] = np.ascontiguousarray(values)
        return self._signals[name]

    @cached_property
    def _signals(self) -> dict[str, FloatArray]:
        """Those that were asked for: next to one another, they are read much faster."""
        return {}

    @cached_property
    def x_m(self) -> FloatArray:
        """Measured position (n,)."""
        return self.signal(self.model.position)

    def pressure(self, c: int) -> FloatArray:
        """Pressure of chamber c (n,), Pa."""
        return self.signal(self.model.chambers[c].pressure)

    def volume(self, c: int) -> FloatArray:
        """Volume of chamber c (n,), m3."""
        return self.model.chambers[c].volume(self.x_m)

    @cached_property
    def seen(self) -> Seen:
        """The record as formulas and functions see it: everything by its name."""
        seen = Seen(self.model, self.t_s, self.chunk[:, 2:])
        vars(seen)["_signals"] = self._signals  # once for both
        return seen

    @cached_property
    def held(self) -> frozenset[str]:
        """Signals that are held between their samples, and not linear."""
        return frozenset(s.name for s in self.model.signals if s.is_held)

    @cached_property
    def placed(self) -> dict[Any, Any]:
        """What `law.placed_on` has found, by the effect's page."""
        return {}

    @property
    def supply_name(self) -> str:
        """Name of the supply's signal, "" where no edge names one."""
        return supply_of(self.model)

    @cached_property
    def supply_is_measured(self) -> bool:
        """False where the supply's signal has no noise: a nominal value, not a measurement."""
        return bool(self.supply_name) and has_noise(self.signal(self.supply_name))

    def may_open(self, edge: Edge) -> BoolArray:
        """True (n,) where the working mode lets an edge open."""
        if not (self.model.mode and edge.modes):
            return np.ones(self.n, bool)
        return np.isin(self.signal(self.model.mode), edge.modes)

    def over_intervals(self, flow: FloatArray) -> FloatArray:
        """Volume (n - 1,), m3, of a flow at the samples (n,), linear between them."""
        return np.asarray(0.5 * (flow[1:] + flow[:-1]) * self.dt_s)

    def flow(self, i: int) -> FloatArray:
        """Flow of edge i by the fitted map (n - 1,), m3/s."""
        return self._along(FLOW)[i]

    def slope_u(self, i: int) -> FloatArray:
        """dQ/dw of edge i (n - 1,), m3/s/V; out of a block by what the whole map rises."""
        return self._along(SLOPE_U)[i]

    def slope_dp(self, i: int) -> FloatArray:
        """dQ/ddp of edge i (n - 1,), m3/s/Pa."""
        return self._along(SLOPE_DP)[i]

    def opening(self, i: int) -> FloatArray:
        """Mean command at the spool of edge i over the intervals (n - 1,), V."""
        return self._along(OPENING)[i]

    def flow_sd(self) -> FloatArray:
        """Standard deviation of each edge's flow (edges, n - 1), m3/s; 0 where it is shut."""
        return self._followed((FLOW_SD,))[FLOW_SD]

    def share_of_rated(self, flow: FloatArray) -> FloatArray:
        """The largest share (n - 1,) that flows (edges, n - 1), m3/s, are of the rated ones."""
        rated = np.array([edge.rated_q_m3s for edge in self.model.edges])
        return np.asarray((flow / rated[:, None]).max(axis=0))

    def rest(self) -> None:
        """Let go of what a long record gives again when it is asked for: 0.3 kB a sample."""
        if self.n >= LONG:
            for made in ("_said", "inside", "_signals", "x_m", "seen", "t_s", "dt_s"):
                vars(self).pop(made, None)
            give_back()

    @cached_property
    def inside(self) -> BoolArray:
        """Intervals (n - 1,) without a gap in which every open edge is on its grid."""
        self._along(SLOPE_U)  # every pass tells it
        return self.inside

    def _along(self, what: int) -> FloatArray:
        """What the map says along the record (edges, n - 1), and what is asked for beside it."""
        said = self._said
        if what not in said and self.n < LONG:
            said.update(self._followed(ALL_BUT_SD))
        elif what not in said:
            for old in list(said)[: len(said) + 1 - AT_A_TIME]:
                del said[old]
            said.update(self._followed((what,)))
        said[what] = said.pop(what)  # the newest is the last
        return said[what]

    @cached_property
    def _said(self) -> dict[int, FloatArray]:
        """What was asked for last of what the map says."""
        return {}

    def _followed(self, asked: tuple[int, ...]) -> dict[int, FloatArray]:
        """What the map says along the record, each (edges, n - 1), 0 where it says nothing.

        Block by block: all of it at once takes several times the memory of the record.
        """
        assert self.beside is not None  # a record without a map has nothing to be followed
        model, n = self.model, len(self.chunk)
        n_edges, state = len(model.edges), build(model, self.beside.weights)
        theta, cov = _of_all_cells(model, self.beside.map, FLOW_SD in asked)
        out = {k: np.zeros((n_edges, n)) for k in asked}
        inside, room = np.zeros(n, bool), np.empty((5, n_edges, AT_ONCE)).transpose(2, 1, 0)
        cell, was = np.empty(room.shape[:2], np.int64), np.full((n_edges, 2), np.nan)
        for first in range(0, n, AT_ONCE):
            part = room[: n - first]
            here = slice(first, first + len(part))
            follow_map(state.engine, state.cells, theta, cov, self.chunk, first, part, cell, was)
            inside[here] = np.isfinite(part[:, 0, 0])
            for k, series in out.items():
                np.copyto(series[:, here], part[:, :, k].T, where=inside[here])
        vars(self)["inside"] = inside[1:]
        return {k: series[:, 1:] for k, series in out.items()}

    def smooth(self, values: FloatArray, derivative: int = 0) -> FloatArray:
        """Values (n,) without most of their noise and delay, or their rate; any unit."""
        half = max(2, round(SMOOTH_S / self.step_s))
        if len(values) <= 2 * half:
            return np.zeros(len(values))
        return fitted(values, half, derivative, self.step_s)

    def into_chamber(self, c: int, per_edge: list[FloatArray]) -> FloatArray:
        """Sum of per_edge (n - 1,), m3/s, with the sign with which each feeds chamber c."""
        signs = [edge.sign(self.model.chambers[c]) for edge in self.model.edges]
        total = np.zeros(self.n - 1)
        for sign, values in zip(signs, per_edge, strict=True):
            if sign:
                total += sign * values
        return total

    def chamber_flow(self, c: int) -> FloatArray:
        """Flow of all valves into chamber c by the fitted map (n - 1,), m3/s."""
        return self.into_chamber(c, [self.flow(i) for i in range(len(self.model.edges))])

    @cached_property
    def has_pressures(self) -> bool:
        """True where the pressure of every chamber that has one is measured."""
        kinds = {s.name: s.kind for s in self.model.signals} | {"": PRESSURE}
        return all(kinds.get(c.pressure) == PRESSURE for c in self.model.chambers)


def _of_all_cells(
    model: Machine, flowmap: MapTerms, has_cov: bool
) -> tuple[FloatArray, FloatArray]:
    """Terms (cells, 6), m3/s, and their covariance (cells, 6, 6), or (0, 6, 6), of all blocks."""
    rated = np.repeat(
        [e.rated_q_m3s for e in model.maps],
        [e.grid.shape[0] * e.grid.shape[1] for e in model.maps],
    )
    theta, cov = np.zeros((model.n_cells, TERMS)), np.zeros((0, TERMS, TERMS))
    theta[flowmap.cells] = flowmap.terms * rated[flowmap.cells, None]
    if has_cov and len(flowmap.cov):
        cov = np.eye(TERMS) * (UNKNOWN * rated[:, None, None]) ** 2
        cov[flowmap.cells] = flowmap.cov * rated[flowmap.cells, None, None] ** 2
    return theta, cov
