"""Batch least squares on explicit rows: eq. (8) and (9), and the oracle of the recursion.

Written for clarity, interval by interval with dense columns, independently of the kernels: what
`rtid.kernels` accumulates recursively must equal this to rounding.  With a known xdot the paper's
eq. (11) is met directly: the same filter on both sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from rtid.errors import door
from rtid.estimator.state import (
    Weights,
    fitted_terms,
    flow_noise_floor,
    nominal_weights,
    variance,
)
from rtid.estimator.track import ROW, Track, follow, pressure_drop, stored_per_pressure
from rtid.model import LAPPED, PROPORTIONAL, TAYLOR, Edge, Machine, Term
from rtid.plain import FloatArray, IntArray

Blocks = tuple[tuple[int, int, int], ...]
GAUSS_POINTS = 0.5 + 0.5 / np.sqrt(3) * np.array([-1.0, 1.0])  # of an interval, in its lengths


@dataclass(frozen=True)
class BatchFit:
    """Whitened rows (m, n) and y (m,), and what least squares makes of them.

    blocks: (edge, i, j) of each visited block in the order of its six unknowns; prior (n,):
    information on each parameter.
    """

    rows: FloatArray
    y: FloatArray
    blocks: Blocks
    prior: FloatArray

    @cached_property
    def theta(self) -> FloatArray:
        """(n,), dimensionless: [theta_beta / weight's compliance | flow terms / rated flow]."""
        keep = np.diag(np.sqrt(self.prior))[self.prior > 0]
        rows, y = np.vstack([self.rows, keep]), np.concatenate([self.y, np.zeros(len(keep))])
        return np.asarray(np.linalg.lstsq(rows, y, rcond=None)[0])

    @cached_property
    def gram(self) -> FloatArray:
        """Information matrix (n, n) without prior; unknowns scaled as in the sums."""
        return np.asarray(self.rows.T @ self.rows)


@door
def fit_batch(
    model: Machine,
    t_s: FloatArray,
    values: FloatArray,
    flags: ArrayLike = ROW,
    weights: Weights | None = None,
    prior: tuple[float, float] = (0.0, 0.0),
    xdot_mps: FloatArray | None = None,
) -> BatchFit:
    """Fit all blocks and both compliances together to one record.

    t_s (n,), values (n, signals) in the model's column order, flags (n,) or one for all;
    weights: nominal ones when not given; prior: information on every shared and every flow
    parameter; xdot_mps (n,), where known, replaces the derivative of the position.
    """
    weights = weights or nominal_weights(model)
    flags = np.broadcast_to(np.asarray(flags, np.int64), len(t_s))
    track = follow(model, t_s, values, flags, weights)
    rates, blocks = column_rates(model, t_s, values, track, weights, xdot_mps)
    maker = _integral_rows if model.form == "integral" else _carry_rows
    stacked = maker(model, t_s, values, rates, track, weights)
    y, rows = stacked[:, 0], stacked[:, 1:]
    ridge = np.full(rows.shape[1], prior[1])
    ridge[: len(model.chambers) + len(model.terms)] = prior[0]
    return BatchFit(rows, y, blocks, ridge)


def column_rates(
    model: Machine,
    t_s: FloatArray,
    values: FloatArray,
    track: Track,
    weights: Weights,
    xdot_mps: FloatArray | None = None,
) -> tuple[FloatArray, Blocks]:
    """(intervals, chambers, 2, 1 + n): start and end rate of y and of every column, m3/s."""
    blocks, end = _visited(model, track), track.end
    n_shared = len(model.chambers) + len(model.terms)
    out = np.zeros((len(end), len(model.chambers), 2, 1 + n_shared + 6 * len(blocks)))
    place = {block: 1 + n_shared + 6 * b for b, block in enumerate(blocks)}
    dt = t_s[end] - t_s[end - 1]
    x = values[:, model.column(model.position)]
    for c, chamber in enumerate(model.chambers):
        area = chamber.sign * chamber.area_m2
        p = values[:, model.column(chamber.pressure)] if chamber.pressure else np.zeros(len(t_s))
        pdot = (p[end] - p[end - 1]) / dt * weights.compliance[c]
        for side, instants in enumerate((end - 1, end)):
            rate = (x[end] - x[end - 1]) / dt if xdot_mps is None else xdot_mps[instants]
            out[:, c, side, 0] = area * rate
            out[:, c, side, 1 + c] = -(chamber.v0_m3 + area * x[instants]) * pdot
    for number, term in enumerate(model.terms):
        flow = term_rates(model, term, values, end, dt)
        for c, chamber in enumerate(model.chambers):
            sign = dict(term.signs).get(chamber.name, 0)
            out[:, c, :, 1 + len(model.chambers) + number] = sign * flow
    moments, owners = _moments(track.opening, dt, weights.lag_s), model.owners
    for i, edge in enumerate(model.edges):
        dp = pressure_drop(model, edge, values)
        ends = np.stack([dp[end - 1], dp[end]], axis=1)
        w = _at_gauss_points(track.opening[:, i], dt, weights.lag_s)
        for cell in np.unique(track.cells[track.cells[:, i, 0] >= 0, i], axis=0):
            here = np.flatnonzero((track.cells[:, i] == cell).all(axis=1))
            for a, b in _windows(edge, cell):
                if edge.basis != TAYLOR:
                    phi = _windowed_terms(edge, a, b, w[here], ends[here])
                else:
                    phi = _terms(edge, a, b, moments[here, i], ends[here])
                at = place[(owners[i], a, b)]
                for c, chamber in enumerate(model.chambers):
                    flow = edge.sign(chamber) * edge.rated_q_m3s * phi * fitted_terms(edge)
                    out[here, c, :, at : at + 6] += flow
    return out, blocks


_SHAPES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "linear": lambda z: z,
    "root": lambda z: np.sign(z) * np.sqrt(np.abs(z)),
    "hinge": lambda z: np.maximum(z, 0.0),
    "inverse": lambda z: -1.0 / z,
}


def term_rates(
    model: Machine, term: Term, values: FloatArray, end: IntArray, dt: FloatArray
) -> FloatArray:
    """(intervals, 2), m3/s: flow of a shared term, theta = 1, at both ends of each interval."""
    z = np.full(len(values), term.constant)
    for name, weight in term.weights:
        z += weight * values[:, model.column(name)]
    f = _SHAPES[term.shape](z)
    if not term.rate:
        return np.asarray(term.scale * np.stack([f[end - 1], f[end]], axis=1))
    volume = np.ones(len(values))
    for chamber in model.chambers:
        if chamber.name == term.volume:
            x = values[:, model.column(model.position)]
            volume = chamber.volume(x)
    rate = -term.scale * (f[end] - f[end - 1]) / dt
    return np.stack([volume[end - 1] * rate, volume[end] * rate], axis=1)


def _windows(edge: Edge, cell: IntArray) -> tuple[tuple[int, int], ...]:
    """The blocks that share a working point: one, or up to two by two where windows overlap."""
    a, b = int(cell[0]), int(cell[1])
    if edge.basis == TAYLOR:
        return ((a, b),)
    nu, nd = edge.grid.shape
    return tuple((i, j) for i in range(a, min(a + 2, nu)) for j in range(b, min(b + 2, nd)))


def _visited(model: Machine, track: Track) -> Blocks:
    """Blocks in the order of their first visit, as the engine gives out its slots."""
    seen: dict[tuple[int, int, int], None] = {}
    for interval in track.cells:
        for i, edge in enumerate(model.edges):
            if interval[i, 0] >= 0:
                for a, b in _windows(edge, interval[i]):
                    seen.setdefault((model.owners[i], a, b))
    return tuple(seen)


def _at_gauss_points(opening: FloatArray, dt: FloatArray, lag_s: float) -> FloatArray:
    """Lagged command at the two Gauss points of each interval (intervals, 2)."""
    command, start = opening[:, :1], opening[:, 1:]
    t = GAUSS_POINTS * dt[:, None]
    return np.asarray(command + (start - command) * (np.exp(-t / lag_s) if lag_s > 0 else 0 * t))


def _windowed_terms(edge: Edge, i: int, j: int, w: FloatArray, dp: FloatArray) -> FloatArray:
    """(intervals, 2, 6): windowed terms at both ends, on the line through two Gauss points.

    w, dp (intervals, 2): the command at the Gauss points, the pressure drop at the ends.
    """
    drop = dp[:, :1] + GAUSS_POINTS * np.diff(dp)
    axis = _local_cosines if edge.basis == LAPPED else _blended
    along_u = _proportional if edge.basis == PROPORTIONAL else axis
    a, b = along_u(edge.grid.u_v, i, w), axis(edge.grid.dp_pa, j, drop)
    pairs = ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2), (1, 1))
    phi = np.stack([a[k] * b[m] for k, m in pairs], axis=-1)
    half = 0.5 * (phi[:, 1] - phi[:, 0]) / (GAUSS_POINTS[1] - GAUSS_POINTS[0])
    mean = phi.mean(axis=1)
    return np.stack([mean - half, mean + half], axis=1)


def _window(border: FloatArray, i: int, at: FloatArray) -> FloatArray:
    """Window (12) of block i, for each point of an array: none falls at the grid's ends."""
    n, width = len(border) - 1, np.diff(border)
    window = np.ones(at.shape)
    if i > 0:
        t = (at - border[i]) / (0.5 * min(width[i - 1], width[i]))
        window = np.sin(np.pi / 4 * (1 + np.clip(t, -1, 1)))
    if i < n - 1:
        t = (border[i + 1] - at) / (0.5 * min(width[i], width[i + 1]))
        window = window * np.sin(np.pi / 4 * (1 + np.clip(t, -1, 1)))
    return window


def _local_cosines(border: FloatArray, i: int, at: FloatArray) -> FloatArray:
    """(3, *points): the window times cos(pi (k + 1/2) s); the last block's cosines are even."""
    s = (at - border[i]) / (border[i + 1] - border[i])
    shift = 0.5 if i < len(border) - 2 else 0.0
    return _window(border, i, at) * np.stack([np.cos(np.pi * (k + shift) * s) for k in range(3)])


def _blended(border: FloatArray, i: int, at: FloatArray) -> FloatArray:
    """(3, *points): the window's square times 1, xi and xi^2."""
    xi = (2 * at - border[i] - border[i + 1]) / (border[i + 1] - border[i])
    return _window(border, i, at) ** 2 * np.stack([np.ones(at.shape), xi, xi**2])


def _proportional(border: FloatArray, i: int, at: FloatArray) -> FloatArray:
    """(3, *points): w within block i as a share of its far end, and nothing else."""
    last = i == len(border) - 2
    inside = (at >= border[i]) & ((at <= border[i + 1]) if last else (at < border[i + 1]))
    share = np.where(inside, at / np.abs(border[i : i + 2]).max(), 0.0)
    return np.stack([share, 0.0 * share, 0.0 * share])


def _moments(opening: FloatArray, dt: FloatArray, lag_s: float) -> FloatArray:
    """Mean of w, of w^2 and of w (t/dt - 1/2) per interval and edge, by fine quadrature.

    The nodes are dense at the start of the interval, where a fast spool moves.
    """
    nodes, weights = np.polynomial.legendre.leggauss(60)
    s = 0.5 * (nodes + 1)
    tau, weights = s**3, 0.5 * weights * 3 * s**2
    command, start = opening[:, :, :1], opening[:, :, 1:]
    fade = np.exp(-tau * dt[:, None, None] / lag_s) if lag_s > 0 else np.zeros(len(tau))
    w = command + (start - command) * fade
    return np.stack([w @ weights, w**2 @ weights, (w - command) * (tau - 0.5) @ weights], axis=2)


def _terms(edge: Edge, i: int, j: int, moments: FloatArray, dp: FloatArray) -> FloatArray:
    """(intervals, 2, 6): the terms at both ends, their mean exact for the moving command.

    moments (intervals, 3) of the command, dp (intervals, 2) at the ends.
    """
    u, p = edge.grid.u_v, edge.grid.dp_pa
    uc, hu = 0.5 * (u[i] + u[i + 1]), 0.5 * (u[i + 1] - u[i])
    pc, hp = 0.5 * (p[j] + p[j + 1]), 0.5 * (p[j + 1] - p[j])
    m1, m2, mt = moments.T
    xi, xi2 = (m1 - uc) / hu, (m2 - 2 * uc * m1 + uc**2) / hu**2
    first, last = (dp.T - pc) / hp
    rise, middle, none = last - first, 0.5 * (first + last), np.zeros(len(dp))
    square = (first**2 + first * last + last**2) / 3
    cross = xi * middle + mt / hu * rise
    mean = np.stack([none + 1.0, xi, middle, xi2, square, cross], axis=1)
    half = 0.5 * np.stack([none, none, rise, none, last**2 - first**2, xi * rise], axis=1)
    return np.stack([mean - half, mean + half], axis=1)


def position_noise(model: Machine, values: FloatArray, weights: Weights) -> FloatArray:
    """Covariance (chambers, chambers) of the white noise of one pair of rows at values, m6.

    values (signals,), SI, of the sample at which the rows end.
    """
    a = np.array([c.sign * c.area_m2 for c in model.chambers])
    p = np.array([variance(model, c.pressure) * model.pressure_share for c in model.chambers])
    white = np.diag(stored_per_pressure(model, values, weights.compliance) ** 2 * p)
    return np.asarray(np.outer(a, a) * variance(model, model.position) + white)


def flow_noise(model: Machine, cells: IntArray, dt: float, weights: Weights) -> FloatArray:
    """Covariance added by one interval: pressure noise through the slope of the open maps.

    (chambers, chambers), m6.  cells (edges, 2): the interval's block per edge, -1 when shut.
    """
    q = np.diag(flow_noise_floor(model)) * dt
    for (a, b), edge, first in zip(cells, model.edges, model.first_cells, strict=True):
        if a >= 0:
            at = first + a * edge.grid.shape[1] + b
            s = np.array([edge.sign(chamber) for chamber in model.chambers])
            noise = variance(model, edge.source) + variance(model, edge.sink)
            noise *= weights.slopes[at] ** 2 * (model.pressure_period_s or dt)
            q = q + np.outer(s, s) * (noise + weights.missed[at]) * dt
    return q


def _integral_rows(
    model: Machine,
    t_s: FloatArray,
    values: FloatArray,
    rates: FloatArray,
    track: Track,
    weights: Weights,
) -> FloatArray:
    """Whitened rows of the integral form: the Kalman whitener on y and all columns alike."""
    cov, gap = np.zeros((rates.shape[1],) * 2), np.zeros(rates.shape[1::2])
    rows = [np.empty((0, rates.shape[3]))]
    for k, end in enumerate(track.end):
        if track.fresh[k]:
            cov, gap = position_noise(model, values[end - 1], weights), np.zeros_like(gap)
        dt = t_s[end] - t_s[end - 1]
        gap = gap + rates[k].mean(axis=1) * dt
        cov = cov + flow_noise(model, track.home[k], dt, weights)
        if track.row[k]:
            s = cov + position_noise(model, values[end], weights)
            rows.append(np.linalg.solve(np.linalg.cholesky(s), gap))
            gain = cov @ np.linalg.inv(s)
            gap = gap - gain @ gap
            cov = cov - gain @ cov
    return np.concatenate(rows)


def _ramp_step(a: FloatArray, wn: float, dt: float) -> FloatArray:
    """exp of the filter augmented with an input that runs linearly over dt: (4, 4)."""
    system = np.zeros((4, 4))
    system[:2, :2] = a * dt
    system[1, 2] = wn * wn * dt
    system[2, 3] = 1.0
    return np.asarray(expm(system))


def _carry_rows(
    model: Machine,
    t_s: FloatArray,
    values: FloatArray,
    rates: FloatArray,
    track: Track,
    weights: Weights,
) -> FloatArray:
    """Rows of the filtered form: every column through H_f, its state carried through all blocks."""
    wn, zeta = model.filter.wn_rad_s, model.filter.zeta
    a = np.array([[0.0, 1.0], [-wn * wn, -2 * zeta * wn]])
    period, due, since = 1 / model.filter.rows_per_s, 0.0, np.nan
    state = np.zeros((2, *rates.shape[1::2]))
    rows = [np.empty((0, rates.shape[3]))]
    for k, end in enumerate(track.end):
        if track.fresh[k]:
            state[:] = 0.0
        if track.started_s[k] != since:
            since = track.started_s[k]
            due = since + period
        dt = t_s[end] - t_s[end - 1]
        step = _ramp_step(a, wn, dt)
        start, change = rates[k, :, 0], rates[k, :, 1] - rates[k, :, 0]
        state = np.einsum("ij,j...->i...", step[:2, :2], state)
        state += step[:2, 2, None, None] * start + step[:2, 3, None, None] * change
        if t_s[end] > due - 0.5 * dt:
            due += period * max(1.0, np.ceil((t_s[end] - due) / period))
            scale = np.linalg.cholesky(position_noise(model, values[end], weights))
            rows.append(np.linalg.solve(scale, state[0]))
    return np.concatenate(rows)
