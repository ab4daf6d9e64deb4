"""Variance of the estimator against generalised least squares on all raw samples.

Raw data are z_c(k) = s_c A_c x(k), with an unknown start per chamber, explained by the integrals
of all columns.  Their noise, linearised: position; pressure through V dP and, as a random walk,
through the true slopes dQ/ddp.  A linear estimator theta = G^-1 X' W' W z has the covariance
G^-1 (B' Sigma B + prior) G^-1 with B = W' W X and G = X' B + prior: no sampling is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from rtid.estimator.batch import Blocks, column_rates, flow_noise, position_noise
from rtid.estimator.factor import PRIOR_SD, SHARED_PRIOR
from rtid.estimator.record import fit_record
from rtid.estimator.state import Weights, nominal_weights, variance
from rtid.estimator.track import Track, follow
from rtid.kernels.holds import second_order
from rtid.model import Grid, Lag, Machine
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw
from rtid.sim.run import Run, simulate
from rtid.sim.simulated_plant import EDGES, SimulatedPlant

RECORD_S, FIRST = 12.0, 6000
GRID = Grid(np.array([1.0, 2.0, 3.0, 4.5, 10.5]), np.array([-1.0, 1.0, 2.5, 5.0, 10.0]) * 1e6)
KNOWN = 0.02  # of the rated flow: map values that the raw data determine at least so well


@dataclass(frozen=True)
class Problem:
    """Noise-free columns of N samples, and the noise of the raw data.

    steps (N - 1, 2, n): increments of the columns; own, later (pressures, N, 2): what the noise of
    a pressure at one sample adds to z at that sample, and at all later ones.
    """

    model: Machine
    track: Track
    dt_s: float
    x_m: FloatArray
    steps: FloatArray
    own: FloatArray
    later: FloatArray
    sd_pa: FloatArray
    prior: FloatArray
    values: FloatArray  # (map values, n): block means and centres, in units of the rated flow


def ratios(seed: int, n: int = 3000) -> dict[str, tuple[float, float]]:
    """Variance of each form over that of generalised least squares: (theta_beta, median of map).

    n: number of raw samples.
    """
    plant = draw(seed)
    run = simulate(plant, "rich", seed, RECORD_S)
    model = replace(declared_model(plant, seed=seed, grid=GRID), lag=Lag(plant.lag_s, 0.0))
    samples = run.samples
    chunk = np.column_stack([samples.t_us * 1e-6, samples.flags, samples.values])
    found = fit_record(model, chunk).weights
    believed = replace(found, missed=np.zeros(0))
    problem = pose(model, plant, run, n)
    best = least_covariance(problem)
    known = np.einsum("vi,ij,vj->v", problem.values, best, problem.values) < KNOWN**2
    out = {}
    forms: dict[str, Callable[[FloatArray], FloatArray]] = {
        "record": lambda z: whitened(problem, found, z),
        "believed": lambda z: whitened(problem, believed, z),
        "live": lambda z: whitened(problem, nominal_weights(model), z),
        "windows": lambda z: windowed(problem, z),
        "carry": lambda z: filtered(problem, z),
    }
    for name, twice in forms.items():
        cov = covariance(problem, twice(problem.steps))
        c, b = (_variances(problem.values[known], m) for m in (cov, best))
        beta = np.diag(cov)[:2] / np.diag(best)[:2]
        out[name] = (float(beta.mean()), float(np.median(c / b)))
    return out


def _variances(values: FloatArray, cov: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("vi,ij,vj->v", values, cov, values))


def pose(model: Machine, plant: SimulatedPlant, run: Run, n: int) -> Problem:
    """The linearised problem of n samples in the middle of the record."""
    cut = slice(FIRST, FIRST + n)
    t_s = np.asarray(run.samples.t_us[cut] * 1e-6, np.float64)
    values = run.truth.signals[cut]
    weights = nominal_weights(model)
    track = follow(model, t_s, values, np.ones(n, np.int64), weights)
    if len(track.end) != n - 1:
        raise ValueError("the record has gaps")
    rates, blocks = column_rates(model, t_s, values, track, weights)
    dt = float(t_s[1] - t_s[0])
    prior = np.full(rates.shape[3] - 1, PRIOR_SD**-2)
    prior[:2] = SHARED_PRIOR
    own, later = _pressure_noise(model, plant, run, cut, dt)
    names = [s.name for s in model.signals if s.kind == "pressure"]
    sd = np.sqrt([variance(model, name) for name in names])
    map_values = _map_values(track, rates, blocks)
    x = values[:, model.column(model.position)]
    steps = rates.mean(axis=2)[:, :, 1:] * dt
    return Problem(model, track, dt, x, steps, own, later, sd, prior, map_values)


def _map_values(track: Track, rates: FloatArray, blocks: Blocks) -> FloatArray:
    """(2 blocks, n): flow averaged over the data of each block, and at its centre, over rated."""
    out = np.zeros((2 * len(blocks), rates.shape[3] - 1))
    for b, (i, *cell) in enumerate(blocks):
        at = slice(2 + 6 * b, 8 + 6 * b)
        inside = (track.cells[:, i] == cell).all(axis=1)
        terms = rates[inside, :, :, 3 + 6 * b : 9 + 6 * b]
        chamber = int(np.argmax(np.abs(terms[0, :, 0, 0])))
        mean = terms[:, chamber].mean(axis=(0, 1))
        out[2 * b, at] = mean / mean[0]  # the first term is 1 times sign and rated flow
        out[2 * b + 1, at.start] = 1.0
    return out


def _pressure_noise(
    model: Machine, plant: SimulatedPlant, run: Run, cut: slice, dt: float
) -> tuple[FloatArray, FloatArray]:
    names = [s.name for s in model.signals if s.kind == "pressure"]
    values, opening = run.truth.signals[cut], run.truth.opening_v[cut]
    own, later = np.zeros((2, len(names), len(values), 2))
    x = values[:, model.column(model.position)]
    for c, chamber in enumerate(model.chambers):
        volume = chamber.v0_m3 + chamber.sign * chamber.area_m2 * x
        own[names.index(chamber.pressure), :, c] = volume / plant.beta_pa
    for edge in model.edges:
        dp = values[:, model.column(edge.source)] - values[:, model.column(edge.sink)]
        w = opening[:, EDGES.index(edge.name)]
        slope = (plant.flow(edge.name, w, dp + 100) - plant.flow(edge.name, w, dp - 100)) / 200
        before = np.append(0.0, slope[1:])  # none before the first sample
        for c, chamber in enumerate(model.chambers):
            sigma = (edge.sink == chamber.pressure) - int(edge.source == chamber.pressure)
            for name, sign in ((edge.source, 1), (edge.sink, -1)):
                s = names.index(name)
                own[s, :, c] -= sigma * sign * 0.5 * dt * before
                later[s, :, c] -= sigma * sign * 0.5 * dt * (before + slope)
    return own, later


def least_covariance(p: Problem) -> FloatArray:
    """Covariance (n, n) of generalised least squares with the full covariance of z."""
    count = len(p.x_m)
    sigma = np.zeros((count, 2, count, 2))
    areas = np.array([c.sign * c.area_m2 for c in p.model.chambers])
    x_var = variance(p.model, p.model.position)
    at = np.arange(count)
    earlier = np.minimum.outer(at, at)
    for a in range(2):
        for b in range(2):
            block = np.zeros((count, count))
            for s, sd in enumerate(p.sd_pa):
                own, later = p.own[s], p.later[s]
                sums = np.append(0.0, np.cumsum(later[:, a] * later[:, b]))[:count]
                cross = np.where(
                    at[:, None] < at[None, :],
                    (own[:, a] * later[:, b])[:, None],
                    (later[:, a] * own[:, b])[None, :],
                )
                np.fill_diagonal(cross, own[:, a] * own[:, b])
                block += sd**2 * (sums[earlier] + cross)
            block[at, at] += areas[a] * areas[b] * x_var
            sigma[:, a, :, b] = block
    columns = np.concatenate([np.zeros((1, *p.steps.shape[1:])), np.cumsum(p.steps, axis=0)])
    columns = columns.reshape(2 * count, -1)
    starts = np.tile(np.eye(2), (count, 1))
    scale = 1.0 / np.sqrt(np.diag(sigma.reshape(2 * count, 2 * count)))
    matrix = sigma.reshape(2 * count, 2 * count) * scale[:, None] * scale
    x = np.hstack([columns, starts]) * scale[:, None]
    information = x.T @ cho_solve(cho_factor(matrix), x)
    n = len(p.prior)
    own = information[:n, :n] - information[:n, n:] @ np.linalg.solve(
        information[n:, n:], information[n:, :n]
    )
    return np.asarray(np.linalg.inv(own + np.diag(p.prior)))


def covariance(p: Problem, back: FloatArray) -> FloatArray:
    """Sandwich covariance of the estimator with back = W' W steps, as increments (N - 1, 2, n)."""
    count = len(p.x_m)
    gram = np.einsum("kci,kcj->ij", p.steps, back) + np.diag(p.prior)
    on_z = np.zeros((count, *back.shape[1:]))  # z(k) enters step k - 1 with +, step k with -
    on_z[1:] += back
    on_z[:-1] -= back
    after = np.zeros_like(on_z)
    after[:-1] = np.cumsum(on_z[::-1], axis=0)[::-1][1:]
    areas = np.array([c.sign * c.area_m2 for c in p.model.chambers])
    parts = [np.sqrt(variance(p.model, p.model.position)) * np.einsum("c,kci->ki", areas, on_z)]
    for s, sd in enumerate(p.sd_pa):
        own, later = p.own[s][:, :, None], p.later[s][:, :, None]
        parts.append(sd * (own * on_z + later * after).sum(axis=1))
    middle = sum(part.T @ part for part in parts) + np.diag(p.prior)
    inverse = np.linalg.inv(gram)
    return np.asarray(inverse @ middle @ inverse)


def noise_at(p: Problem, x_m: float, weights: Weights) -> FloatArray:
    """Covariance (2, 2) of the white noise at a position; there are no terms."""
    values = np.zeros(len(p.model.signals))
    values[p.model.column(p.model.position)] = x_m
    return position_noise(p.model, values, weights)


def whitened(p: Problem, weights: Weights, steps: FloatArray) -> FloatArray:
    """W' W steps of the Kalman whitener: forwards, then its adjoint backwards."""
    count = len(p.x_m)
    cov = noise_at(p, p.x_m[0], weights)
    gap, keep, rows = np.zeros(steps.shape[1:]), [], []
    for k in range(count - 1):
        gap = gap + steps[k]
        cov = cov + flow_noise(p.model, p.track.cells[k], p.dt_s, weights)
        s = cov + noise_at(p, p.x_m[k + 1], weights)
        keep.append(np.eye(2) - cov @ np.linalg.inv(s))
        rows.append(np.linalg.solve(s, gap))
        gap = keep[-1] @ gap
        cov = keep[-1] @ cov
    out, ahead = np.zeros_like(steps), np.zeros(steps.shape[1:])
    for k in reversed(range(count - 1)):
        ahead = rows[k] + (keep[k].T @ ahead if k < count - 2 else 0.0)
        out[k] = ahead
    return out


def windowed(p: Problem, steps: FloatArray, window_s: float = 1.5) -> FloatArray:
    """Plain integral rows, weighed by the position noise alone, one intercept per window."""
    count = len(p.x_m)
    weights = nominal_weights(p.model)
    z = np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])
    out = np.zeros_like(z)
    size = round(window_s / p.dt_s)
    inverse = np.linalg.inv(noise_at(p, float(p.x_m.mean()), weights))
    for first in range(0, count, size):
        part = z[first : first + size]
        out[first : first + size] = np.einsum("ab,kbi->kai", inverse, part - part.mean(axis=0))
    return np.asarray(np.cumsum(out[::-1], axis=0)[::-1][1:])


def filtered(p: Problem, steps: FloatArray) -> FloatArray:
    """Rows of the carry form: the filter over all steps, sampled at the row rate."""
    count = len(p.x_m)
    a, b = np.empty((2, 2)), np.empty((2, 2))
    second_order(p.model.filter.wn_rad_s, p.model.filter.zeta, p.dt_s, a, b)
    gain = b.sum(axis=1) / p.dt_s
    every = round(1 / p.model.filter.rows_per_s / p.dt_s)
    weights = nominal_weights(p.model)
    inverse = np.linalg.inv(noise_at(p, float(p.x_m.mean()), weights))
    state, rows = np.zeros((2, *steps.shape[1:])), {}
    for k in range(count - 1):
        state = np.einsum("rs,sci->rci", a, state) + gain[:, None, None] * steps[k]
        if (k + 1) % every == 0:
            rows[k] = inverse @ state[0]
    out, ahead = np.zeros_like(steps), np.zeros_like(state)
    for k in reversed(range(count - 1)):
        ahead = np.einsum("sr,sci->rci", a, ahead)
        if k in rows:
            ahead[0] += rows[k]
        out[k] = np.einsum("r,rci->ci", gain, ahead)
    return out
