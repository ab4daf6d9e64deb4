"""Batch least squares on explicit rows: eq. (8) and (9), and the oracle of the recursion.

Written for clarity, sample by sample with dense columns, independently of the kernels: what
`rtid.kernels` accumulates recursively must equal this to rounding.  With a known xdot the paper's
eq. (11) is met directly: the same filter on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from rtid.estimator.state import build
from rtid.kernels.layout import COUNTERS
from rtid.model import FloatArray, Model

RESTARTS = tuple(COUNTERS.index(n) for n in COUNTERS if n.startswith("restart"))


@dataclass(frozen=True)
class BatchFit:
    """theta (n,): [beta_nominal / beta per chamber | flow terms / rated flow per visited block].

    blocks: (edge, i, j) of each visited block in the order of its six unknowns; rows (m, n) and
    y (m,) are whitened; gram = rows' rows.
    """

    theta: FloatArray
    rows: FloatArray
    y: FloatArray
    blocks: tuple[tuple[int, int, int], ...]

    @property
    def gram(self) -> FloatArray:
        """Information matrix (n, n) without prior."""
        return self.rows.T @ self.rows


def fit_batch(
    model: Model,
    t_s: FloatArray,
    values: FloatArray,
    ridge: float = 0.0,
    xdot_mps: FloatArray | None = None,
) -> BatchFit:
    """Fit all blocks and both compliances together to one gap-free record.

    t_s (n,), values (n, signals) in the model's column order, position measured at every sample.
    ridge: prior information on every flow term.  xdot_mps (n,), where known, replaces the derivative
    of the position.  Raises ValueError when a working point leaves its grid.
    """
    track = _track(model, t_s, values)
    increments, blocks = _increments(model, t_s, values, track, xdot_mps)
    maker = _carry_rows if model.form == "carry" else _integral_rows
    stacked = maker(model, t_s, values, increments, track)
    y, rows = stacked[:, 0], stacked[:, 1:]
    n_shared = len(model.chambers)
    prior = np.sqrt(ridge) * np.eye(rows.shape[1])[n_shared:]
    theta = np.linalg.lstsq(
        np.vstack([rows, prior]), np.concatenate([y, np.zeros(len(prior))]), rcond=None
    )[0]
    return BatchFit(theta, rows, y, blocks)


@dataclass(frozen=True)
class _Track:
    """Per interval and edge: cell (i, j) or (-1, -1), lagged command moments, restarts, slopes."""

    cells: np.ndarray
    moments: FloatArray
    restarts: np.ndarray
    slopes: FloatArray


def _track(model: Model, t_s: FloatArray, values: FloatArray) -> _Track:
    """Run the engine one sample at a time to learn which block each interval belongs to.

    The assignment (hysteresis, restarts of the memory) is part of the declared rows; everything
    computed from it below is independent of the kernels.
    """
    state = build(model)
    chunk = np.column_stack([t_s, np.ones(len(t_s)), values])
    n, n_edges = len(t_s), len(model.edges)
    cells = np.full((n - 1, n_edges, 2), -1)
    restarts = np.zeros(n - 1, bool)
    before = 0
    for k in range(n):
        state.advance(chunk[k : k + 1])
        e = state.engine[0]
        if not e["running"]:
            raise ValueError(f"the working point leaves its grid at t = {t_s[k]:.3f} s")
        now = int(sum(e["counters"][r] for r in RESTARTS))
        if k > 0:
            cells[k - 1] = e["cell"][:n_edges]
            restarts[k - 1] = now != before
        before = now
    cells[cells[:, :, 0] < 0] = -1
    return _Track(cells, _moments(model, t_s, values), restarts, state.cells["slope"])


def _moments(model: Model, t_s: FloatArray, values: FloatArray) -> FloatArray:
    """Mean of w, of w^2 and of w (t/dt - 1/2) per interval and edge, by fine quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    tau, weights = 0.5 * (nodes + 1), 0.5 * weights
    out = np.empty((len(t_s) - 1, len(model.edges), 3))
    for i, edge in enumerate(model.edges):
        held = edge.direction * values[:, model.column(edge.command)]
        w = held[0]
        for k in range(len(t_s) - 1):
            dt = t_s[k + 1] - t_s[k]
            fade = np.exp(-tau * dt / model.lag.nominal_s) if model.lag.nominal_s > 0 else 0 * tau
            path = held[k] + (w - held[k]) * fade
            out[k, i] = weights @ path, weights @ path**2, weights @ (path * (tau - 0.5))
            last = np.exp(-dt / model.lag.nominal_s) if model.lag.nominal_s > 0 else 0.0
            w = held[k] + (w - held[k]) * last
    return out


def _increments(
    model: Model,
    t_s: FloatArray,
    values: FloatArray,
    track: _Track,
    xdot_mps: FloatArray | None,
) -> tuple[FloatArray, tuple[tuple[int, int, int], ...]]:
    """(intervals, chambers, 2, 1 + n): start and end rate of y and of every column, m3/s."""
    blocks = _visited(track.cells)
    n_shared = len(model.chambers)
    out = np.zeros((len(t_s) - 1, n_shared, 2, 1 + n_shared + 6 * len(blocks)))
    place = {block: 1 + n_shared + 6 * b for b, block in enumerate(blocks)}
    dt = np.diff(t_s)
    x = values[:, model.column(model.position)]
    for c, chamber in enumerate(model.chambers):
        area = chamber.sign * chamber.area_m2
        rate = np.diff(x) / dt
        ends = (rate, rate) if xdot_mps is None else (xdot_mps[:-1], xdot_mps[1:])
        volume = chamber.v0_m3 + area * x
        pdot = np.diff(values[:, model.column(chamber.pressure)]) / dt / model.beta_nominal_pa
        for end in (0, 1):
            out[:, c, end, 0] = area * ends[end]
            out[:, c, end, 1 + c] = -volume[end : end + len(dt)] * pdot
    for i, edge in enumerate(model.edges):
        dp = values[:, model.column(edge.source)] - values[:, model.column(edge.sink)]
        for k in np.flatnonzero(track.cells[:, i, 0] >= 0):
            cell = track.cells[k, i]
            phi = _terms(edge.grid.u_v, edge.grid.dp_pa, cell, track.moments[k, i], dp[k : k + 2])
            at = place[(i, int(cell[0]), int(cell[1]))]
            for c, chamber in enumerate(model.chambers):
                sigma = (edge.sink == chamber.pressure) - (edge.source == chamber.pressure)
                out[k, c, :, at : at + 6] = sigma * edge.rated_q_m3s * phi
    return out, blocks


def _visited(cells: np.ndarray) -> tuple[tuple[int, int, int], ...]:
    """Blocks in the order of their first visit, as the engine gives out its slots."""
    seen: dict[tuple[int, int, int], None] = {}
    for row in cells:
        for i, (a, b) in enumerate(row):
            if a >= 0:
                seen.setdefault((i, int(a), int(b)))
    return tuple(seen)


def _terms(
    u: FloatArray, p: FloatArray, cell: np.ndarray, moments: FloatArray, dp: FloatArray
) -> FloatArray:
    """(2, 6): the terms at both ends of an interval, their mean exact for the moving command."""
    uc, hu = 0.5 * (u[cell[0]] + u[cell[0] + 1]), 0.5 * (u[cell[0] + 1] - u[cell[0]])
    pc, hp = 0.5 * (p[cell[1]] + p[cell[1] + 1]), 0.5 * (p[cell[1] + 1] - p[cell[1]])
    m1, m2, mt = moments
    xi, xi2 = (m1 - uc) / hu, (m2 - 2 * uc * m1 + uc**2) / hu**2
    eta = (dp - pc) / hp
    mean_eta2 = (eta[0] ** 2 + eta[0] * eta[1] + eta[1] ** 2) / 3
    cross = xi * eta.mean() + mt / hu * (eta[1] - eta[0])
    mean = np.array([1.0, xi, eta.mean(), xi2, mean_eta2, cross])
    half = 0.5 * np.array([0, 0, eta[1] - eta[0], 0, eta[1] ** 2 - eta[0] ** 2, xi * (eta[1] - eta[0])])
    return np.stack([mean - half, mean + half])


def _position_noise(model: Model, x_m: float) -> FloatArray:
    """Covariance (chambers, chambers) of the white noise of one pair of rows, m6."""
    a = np.array([c.sign * c.area_m2 for c in model.chambers])
    v = np.array([c.v0_m3 + c.sign * c.area_m2 * x_m for c in model.chambers])
    p = np.array([_sigma2(model, c.pressure) for c in model.chambers])
    return np.outer(a, a) * _sigma2(model, model.position) + np.diag((v / model.beta_nominal_pa) ** 2 * p)


def _sigma2(model: Model, name: str) -> float:
    signal = model.signals[model.column(name)]
    return signal.noise**2 + signal.resolution**2 / 12


def _flow_noise(model: Model, track: _Track, k: int, dt: float, floor: FloatArray) -> FloatArray:
    """Covariance added by one interval: pressure noise through the slope of the open maps."""
    q = np.diag(floor * dt)
    first = 0
    for i, edge in enumerate(model.edges):
        a, b = track.cells[k, i]
        if a >= 0:
            slope = track.slopes[first + a * edge.grid.shape[1] + b]
            s = np.array([(edge.sink == c.pressure) - (edge.source == c.pressure) for c in model.chambers])
            noise = _sigma2(model, edge.source) + _sigma2(model, edge.sink)
            q = q + np.outer(s, s) * slope**2 * noise * (model.pressure_period_s or dt) * dt
        first += edge.grid.shape[0] * edge.grid.shape[1]
    return q


def _integral_rows(
    model: Model, t_s: FloatArray, values: FloatArray, rates: FloatArray, track: _Track
) -> FloatArray:
    """Whitened rows of the integral form: the Kalman whitener on y and all columns alike."""
    floor = build(model).engine[0]["q_floor"][: len(model.chambers)]
    x = values[:, model.column(model.position)]
    cov, gap, rows = _position_noise(model, x[0]), np.zeros(rates.shape[1::2]), []
    for k, dt in enumerate(np.diff(t_s)):
        if track.restarts[k]:
            cov, gap = _position_noise(model, x[k]), np.zeros_like(gap)
        gap = gap + rates[k].mean(axis=1) * dt
        cov = cov + _flow_noise(model, track, k, dt, floor)
        r = _position_noise(model, x[k + 1])
        s = cov + r
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
    model: Model, t_s: FloatArray, values: FloatArray, rates: FloatArray, track: _Track
) -> FloatArray:
    """Rows of the filtered form: every column through H_f, its state carried through all blocks."""
    wn, zeta = model.filter.wn_rad_s, model.filter.zeta
    a = np.array([[0.0, 1.0], [-wn * wn, -2 * zeta * wn]])
    period = 1 / model.filter.rows_per_s
    state = np.zeros((2, *rates.shape[1::2]))
    x = values[:, model.column(model.position)]
    rows, due = [], t_s[0] + period
    for k, dt in enumerate(np.diff(t_s)):
        if track.restarts[k]:
            state[:] = 0.0
        step = _ramp_step(a, wn, dt)
        start, change = rates[k, :, 0], rates[k, :, 1] - rates[k, :, 0]
        state = np.einsum("ij,j...->i...", step[:2, :2], state)
        state += step[:2, 2, None, None] * start + step[:2, 3, None, None] * change
        if t_s[k + 1] > due - 0.5 * dt:
            due += period * max(1.0, np.ceil((t_s[k + 1] - due) / period))
            scale = np.linalg.cholesky(_position_noise(model, x[k + 1]))
            rows.append(np.linalg.solve(scale, state[0]))
    return np.concatenate(rows)
