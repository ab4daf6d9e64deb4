"""What all methods on filtered derivatives share: working points, a filter, the modulus.

With the map's flow Q_c into chamber c, its geometry known, (14) is linear in 1 / beta:

    s_c A_c v = Q_c - V_c dP_c/dt / beta_c

Everything passes the same Gaussian filter, and the derivative is that of the filter.  What is
linear in its unknowns has its columns filtered (exact for commands that step); what is not takes
the filtered signals of rows that stand apart from steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.signal import lfilter

from benchmarks.missing.record import Record
from rtid.model import Edge, Machine
from rtid.plain import BoolArray, FloatArray

FILTER_S = 8e-3  # standard deviation of the filter's response
ROW_S = 0.01
STEP_V = 0.08  # a command that moves more within the filter's length is a step
LENGTH = 3.0  # of the response, in standard deviations


@dataclass(frozen=True)
class Working:
    """Working points at samples or rows: n of them, e edges, c chambers; SI.

    w_v, dp_pa (n, e); sign (c, e): +1 where an edge feeds a chamber; moved (n, c): s A v;
    volume, p_pa, rate (n, c): V, P, dP/dt (NaN where it is to be predicted); steady (n,).
    """

    machine: Machine
    t_s: FloatArray
    w_v: FloatArray
    dp_pa: FloatArray
    sign: FloatArray
    moved: FloatArray
    volume: FloatArray
    p_pa: FloatArray
    rate: FloatArray
    steady: BoolArray

    @property
    def root(self) -> FloatArray:
        """sign(dp) sqrt|dp| (n, e)."""
        return np.sign(self.dp_pa) * np.sqrt(np.abs(self.dp_pa))

    def open(self, edge: int) -> BoolArray:
        """Where an edge may pass anything (n,)."""
        return np.asarray(self.w_v[:, edge] > self.machine.edges[edge].safe_band_v)

    def edges_of(self, chamber: int) -> list[int]:
        """The edges on a chamber."""
        return [int(e) for e in np.flatnonzero(self.sign[chamber])]

    def rates(self, flow: FloatArray, beta_pa: FloatArray) -> FloatArray:
        """dP/dt (n, c) that flows into the chambers (n, c) make."""
        return np.asarray(beta_pa * (flow - self.moved) / self.volume)

    def into(self, flows: FloatArray) -> FloatArray:
        """Flows into the chambers (n, c) of flows through the edges (n, e)."""
        return np.asarray(flows @ self.sign.T)


def opening(edge: Edge, record: Record) -> FloatArray:
    """The command of an edge behind the declared lag (n,), V: of the held command, exact."""
    lag_s, dt_s = record.machine.lag.nominal_s, float(np.median(np.diff(record.t_s)))
    command = edge.direction * record.column(edge.command)
    if lag_s <= 0.0:
        return command
    keep = float(np.exp(-dt_s / lag_s))
    before = np.concatenate([command[:1], command[:-1]])
    start = np.array([keep * command[0]])
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], before, zi=start)[0])


def at_samples(record: Record) -> Working:
    """Every sample as it was measured; v of the record's own signal."""
    machine = record.machine
    return _working(record, record.column("v"), np.full((len(record.t_s), 2), np.nan), machine)


def _working(record: Record, v: FloatArray, rate: FloatArray, machine: Machine) -> Working:
    w = np.stack([opening(e, record) for e in machine.edges], axis=1)
    dp = np.stack([record.column(e.source) - record.column(e.sink) for e in machine.edges], axis=1)
    sign = np.array([[float(e.sign(c)) for e in machine.edges] for c in machine.chambers])
    x, still = record.column(machine.position), np.ones(len(record.t_s), bool)
    area = np.array([c.sign * c.area_m2 for c in machine.chambers])
    volume = np.array([c.v0_m3 for c in machine.chambers]) + x[:, None] * area
    p = np.stack([record.column(c.pressure) for c in machine.chambers], axis=1)
    return Working(machine, record.t_s, w, dp, sign, v[:, None] * area, volume, p, rate, still)


def smooth(values: FloatArray, dt_s: float, order: int = 0) -> FloatArray:
    """Columns (n, k) through the filter, or their derivative of an order."""
    sigma = FILTER_S / dt_s
    return np.asarray(gaussian_filter1d(values, sigma, axis=0, order=order)) / dt_s**order


@dataclass(frozen=True)
class Front:
    """A record prepared once: at its samples, and in rows behind the filter."""

    record: Record

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt_s", float(np.median(np.diff(self.record.t_s))))
        object.__setattr__(self, "samples", at_samples(self.record))

    dt_s: float = 0.0
    samples: Working = None  # type: ignore[assignment]

    @property
    def every(self) -> slice:
        """Rows of the samples: the filter's ends are left out."""
        first, step = round(LENGTH * FILTER_S / self.dt_s), round(ROW_S / self.dt_s)
        return slice(first, len(self.record.t_s) - first, step)

    def filtered(self, columns: FloatArray, order: int = 0) -> FloatArray:
        """Columns at samples (n, k) as rows."""
        return smooth(columns, self.dt_s, order)[self.every]

    def rows(self) -> Working:
        """Filtered signals, dP/dt, and the rows that stand apart from steps of the command."""
        record, s = self.record, self.samples
        values = smooth(record.values, self.dt_s)
        x = record.column(record.machine.position)[:, None]
        # position and velocity sensor see the same motion: each is worth its inverse variance
        v = smooth(x, self.dt_s, 1)[:, 0]
        rate = smooth(s.p_pa, self.dt_s, 1)
        base = _working(Record(record.declared, record.t_s, values), v, rate, record.machine)
        w = smooth(s.w_v, self.dt_s)
        reach = round(2 * LENGTH * FILTER_S / self.dt_s)
        jump = np.abs(np.diff(s.w_v, axis=0, prepend=s.w_v[:1])).max(axis=1)
        steady = maximum_filter1d(jump, reach) * 1.0 < STEP_V
        k = self.every
        return Working(
            base.machine, base.t_s[k], w[k], base.dp_pa[k], base.sign, base.moved[k],
            base.volume[k], base.p_pa[k], base.rate[k], steady[k],
        )  # fmt: skip

    def balance(self) -> tuple[FloatArray, FloatArray]:
        """s A v and V dP/dt as rows (rows, c), filtered alike."""
        s, m = self.samples, self.record.machine
        x = self.record.column(m.position)[:, None]
        area = np.array([c.sign * c.area_m2 for c in m.chambers])
        moved = self.filtered(x, 1) * area
        # V dP/dt = d(V P)/dt - P dV/dt: nothing noisy is differentiated before the filter
        stored = self.filtered(s.volume * s.p_pa, 1) - self.filtered(s.p_pa * s.moved)
        return moved, stored
