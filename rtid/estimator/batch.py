"""Batch least squares on explicit rows: eq. (8) and (9), and the oracle of the recursion.

Written for clarity, interval by interval with dense columns, independently of the kernels: what
`rtid.kernels` accumulates recursively must equal this to rounding.  With a known xdot the paper's
eq. (11) is met directly: the same filter on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from rtid.estimator.state import FLOW_NOISE_FLOOR, Weights, nominal_weights
from rtid.estimator.track import ROW, Track, follow
from rtid.model import Edge, FloatArray, Model

Blocks = tuple[tuple[int, int, int], ...]


@dataclass(frozen=True)
class BatchFit:
    """theta (n,): [theta_beta / its weight's compliance, per chamber | flow terms / rated flow].

    blocks: (edge, i, j) of each visited block in the order of its six unknowns; rows (m, n) and
    y (m,) are whitened; gram = rows' rows.
    """

    theta: FloatArray
    rows: FloatArray
    y: FloatArray
    blocks: Blocks

    @property
    def gram(self) -> FloatArray:
        """Information matrix (n, n) without prior."""
        return np.asarray(self.rows.T @ self.rows)


def fit_batch(
    model: Model,
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
    maker = _carry_rows if model.form == "carry" else _integral_rows
    stacked = maker(model, t_s, values, rates, track, weights)
    y, rows = stacked[:, 0], stacked[:, 1:]
    ridge = np.full(rows.shape[1], prior[1])
    ridge[: len(model.chambers) + len(model.terms)] = prior[0]
    keep = np.diag(np.sqrt(ridge))[ridge > 0]
    theta = np.linalg.lstsq(
        np.vstack([rows, keep]), np.concatenate([y, np.zeros(len(keep))]), rcond=None
    )[0]
    return BatchFit(theta, rows, y, blocks)


def column_rates(
    model: Model,
    t_s: FloatArray,
    values: FloatArray,
    track: Track,
    weights: Weights,
    xdot_mps: FloatArray | None = None,
) -> tuple[FloatArray, Blocks]:
    """(intervals, chambers, 2, 1 + n): start and end rate of y and of every column, m3/s."""
    blocks, end = _visited(track), track.end
    n_shared = len(model.chambers) + len(model.terms)
    out = np.zeros((len(end), len(model.chambers), 2, 1 + n_shared + 6 * len(blocks)))
    place = {block: 1 + n_shared + 6 * b for b, block in enumerate(blocks)}
    dt = t_s[end] - t_s[end - 1]
    x = values[:, model.column(model.position)]
    for c, chamber in enumerate(model.chambers):
        area = chamber.sign * chamber.area_m2
        p = values[:, model.column(chamber.pressure)]
        pdot = (p[end] - p[end - 1]) / dt * weights.compliance[c]
        for side, instants in enumerate((end - 1, end)):
            rate = (x[end] - x[end - 1]) / dt if xdot_mps is None else xdot_mps[instants]
            out[:, c, side, 0] = area * rate
            out[:, c, side, 1 + c] = -(chamber.v0_m3 + area * x[instants]) * pdot
    for number, term in enumerate(model.terms):
        flow = np.full(len(values), term.constant)
        for name, weight in term.weights:
            flow += weight * values[:, model.column(name)]
        for c, chamber in enumerate(model.chambers):
            sign = dict(term.signs).get(chamber.name, 0)
            for side, instants in enumerate((end - 1, end)):
                out[:, c, side, 1 + len(model.chambers) + number] = (
                    sign * term.scale * flow[instants]
                )
    moments = _moments(track.opening, dt, weights.lag_s)
    for i, edge in enumerate(model.edges):
        dp = values[:, model.column(edge.source)] - values[:, model.column(edge.sink)]
        for k in np.flatnonzero(track.cells[:, i, 0] >= 0):
            a, b = (int(j) for j in track.cells[k, i])
            phi = _terms(edge, a, b, moments[k, i], dp[end[k] - 1 : end[k] + 1])
            at = place[(i, a, b)]
            for c, sigma in enumerate(_signs(model, edge)):
                out[k, c, :, at : at + 6] = sigma * edge.rated_q_m3s * phi
    return out, blocks


def _visited(track: Track) -> Blocks:
    """Blocks in the order of their first visit, as the engine gives out its slots."""
    seen: dict[tuple[int, int, int], None] = {}
    for interval in track.cells:
        for i, (a, b) in enumerate(interval):
            if a >= 0:
                seen.setdefault((i, int(a), int(b)))
    return tuple(seen)


def _signs(model: Model, edge: Edge) -> list[int]:
    """+1 for a chamber that the edge feeds, -1 for one that it drains."""
    return [(edge.sink == c.pressure) - int(edge.source == c.pressure) for c in model.chambers]


def _moments(opening: FloatArray, dt: FloatArray, lag_s: float) -> FloatArray:
    """Mean of w, of w^2 and of w (t/dt - 1/2) per interval and edge, by fine quadrature.

    The nodes are dense at the start of the interval, where a fast spool moves.
    """
    nodes, weights = np.polynomial.legendre.leggauss(60)
    s = 0.5 * (nodes + 1)
    tau, weights = s**3, 0.5 * weights * 3 * s**2
    held, start = opening[:, :, :1], opening[:, :, 1:]
    fade = np.exp(-tau * dt[:, None, None] / lag_s) if lag_s > 0 else np.zeros(len(tau))
    w = held + (start - held) * fade
    return np.stack([w @ weights, w**2 @ weights, (w - held) * (tau - 0.5) @ weights], axis=2)


def _terms(edge: Edge, i: int, j: int, moments: FloatArray, dp: FloatArray) -> FloatArray:
    """(2, 6): the terms at both ends of an interval, their mean exact for the moving command."""
    u, p = edge.grid.u_v, edge.grid.dp_pa
    uc, hu = 0.5 * (u[i] + u[i + 1]), 0.5 * (u[i + 1] - u[i])
    pc, hp = 0.5 * (p[j] + p[j + 1]), 0.5 * (p[j + 1] - p[j])
    m1, m2, mt = moments
    xi, xi2 = (m1 - uc) / hu, (m2 - 2 * uc * m1 + uc**2) / hu**2
    eta = (dp - pc) / hp
    mean_eta2 = (eta[0] ** 2 + eta[0] * eta[1] + eta[1] ** 2) / 3
    cross = xi * eta.mean() + mt / hu * (eta[1] - eta[0])
    mean = np.array([1.0, xi, eta.mean(), xi2, mean_eta2, cross])
    rise = eta[1] - eta[0]
    half = 0.5 * np.array([0, 0, rise, 0, eta[1] ** 2 - eta[0] ** 2, xi * rise])
    return np.stack([mean - half, mean + half])


def position_noise(model: Model, x_m: float, weights: Weights) -> FloatArray:
    """Covariance (chambers, chambers) of the white noise of one pair of rows, m6."""
    a = np.array([c.sign * c.area_m2 for c in model.chambers])
    v = np.array([c.v0_m3 + c.sign * c.area_m2 * x_m for c in model.chambers])
    p = np.array([variance(model, c.pressure) * model.pressure_share for c in model.chambers])
    white = np.diag((v * weights.compliance[: len(a)]) ** 2 * p)
    return np.asarray(np.outer(a, a) * variance(model, model.position) + white)


def variance(model: Model, name: str) -> float:
    """Declared sensor noise and quantisation of a signal, SI squared."""
    signal = model.signals[model.column(name)]
    return signal.noise**2 + signal.resolution**2 / 12


def _least_flow_noise(model: Model) -> FloatArray:
    """(chambers, chambers), m6/s: a share of what the rated slope of the noisiest edge gives."""
    least = np.zeros(len(model.chambers))
    for edge in model.edges:
        slope = 0.5 * edge.rated_q_m3s / edge.rated_dp_pa
        noise = variance(model, edge.source) + variance(model, edge.sink)
        size = FLOW_NOISE_FLOOR * slope**2 * noise * (model.pressure_period_s or 1e-3)
        least = np.maximum(least, np.abs(_signs(model, edge)) * size)
    return np.diag(least)


def flow_noise(model: Model, cells: FloatArray, dt: float, weights: Weights) -> FloatArray:
    """Covariance added by one interval: pressure noise through the slope of the open maps.

    cells (edges, 2): the interval's block per edge, -1 when shut.
    """
    q, first = _least_flow_noise(model) * dt, 0
    for (a, b), edge in zip(cells, model.edges, strict=True):
        if a >= 0:
            slope = weights.slopes[first + a * edge.grid.shape[1] + b]
            s = np.array(_signs(model, edge))
            noise = variance(model, edge.source) + variance(model, edge.sink)
            q = q + np.outer(s, s) * slope**2 * noise * (model.pressure_period_s or dt) * dt
        first += edge.grid.shape[0] * edge.grid.shape[1]
    return q


def _integral_rows(
    model: Model,
    t_s: FloatArray,
    values: FloatArray,
    rates: FloatArray,
    track: Track,
    weights: Weights,
) -> FloatArray:
    """Whitened rows of the integral form: the Kalman whitener on y and all columns alike."""
    x = values[:, model.column(model.position)]
    cov, gap = np.zeros((rates.shape[1],) * 2), np.zeros(rates.shape[1::2])
    rows = [np.empty((0, rates.shape[3]))]
    for k, end in enumerate(track.end):
        if track.fresh[k]:
            cov, gap = position_noise(model, x[end - 1], weights), np.zeros_like(gap)
        dt = t_s[end] - t_s[end - 1]
        gap = gap + rates[k].mean(axis=1) * dt
        cov = cov + flow_noise(model, track.cells[k], dt, weights)
        if track.row[k]:
            s = cov + position_noise(model, x[end], weights)
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
    model: Model,
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
    x = values[:, model.column(model.position)]
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
            scale = np.linalg.cholesky(position_noise(model, x[end], weights))
            rows.append(np.linalg.solve(scale, state[0]))
    return np.concatenate(rows)
