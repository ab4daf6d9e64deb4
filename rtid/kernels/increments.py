"""What one interval adds to the columns of eq. (14), and to the noise that weighs them.

e, cells and blocks are records or record arrays of `layout` and are changed in place.
"""

from __future__ import annotations

import math
from typing import Any

from rtid.kernels.basis import window_axis, window_terms
from rtid.kernels.holds import GAUSS
from rtid.kernels.jit import inlined, part
from rtid.kernels.layout import (
    BLENDED,
    FLOW,
    HINGE,
    INTEGRAL,
    INVERSE,
    PROPORTIONAL,
    RATE,
    ROOT,
    TERMS,
)
from rtid.plain import FloatArray

LEAST_Z = 1e-12  # below which a root is no steeper
HELD_MISFIT = 5e-4  # of an edge's scale: what six terms miss of a flow at the borders of a block


@inlined
def shared_increments(e: Any, sample: FloatArray, dt: float) -> None:
    """y: s A dx; theta_beta: -V dP (scaled by the nominal compliance), exact for linear x and P.

    sample (2 + signals,), SI.  Carry form: the rates at both ends of the interval instead of the
    integrals.
    """
    x0, x1 = e.values[e.x_column], sample[2 + e.x_column]
    for c in range(e.n_chambers):
        dx = e.area_m2[c] * (x1 - x0)
        dp = -e.compliance[c] * (sample[2 + e.p_column[c]] - e.values[e.p_column[c]])
        v0, v1 = e.v0_m3[c] + e.growth_m2[c] * x0, e.v0_m3[c] + e.growth_m2[c] * x1
        if e.form != INTEGRAL:
            e.inc[c, 0], e.end[c, 0] = dx / dt, dx / dt
            e.inc[c, 1 + c], e.end[c, 1 + c] = dp * v0 / dt, dp * v1 / dt
        else:
            e.d[c, 0] += dx
            e.d[c, 1 + c] += 0.5 * (v0 + v1) * dp
            if e.gate_sd > 0.0:
                e.gap[c] += dx - 0.5 * (v0 + v1) * dp * e.held_compliance[c]


@inlined
def argument(e: Any, k: int, values: FloatArray, first: int) -> float:
    """z of shared term k, SI; its signals stand in values (m,) from `first` on."""
    z = e.term_constant[k]
    for j in range(e.n_signals):
        z += e.term_weight[k, j] * values[first + j]
    return float(z)


@inlined
def shaped(e: Any, k: int, values: FloatArray, first: int) -> float:
    """f(z) of shared term k, SI; values (m,) as in `argument`."""
    z, shape = argument(e, k, values, first), e.term_shape[k]
    if shape == ROOT:
        return math.copysign(math.sqrt(abs(z)), z)
    if shape == HINGE:
        return max(0.0, float(z))
    if shape == INVERSE:
        return -1.0 / z
    return float(z)


@part
def term_rates(e: Any, k: int, sample: FloatArray, dt: float) -> tuple[float, float]:
    """Flow of shared term k for theta = 1 at both ends, m3/s; sample (2 + signals,)."""
    start, end = shaped(e, k, e.values, 0), shaped(e, k, sample, 2)
    scale, volume = e.term_scale[k], e.term_volume[k]
    if volume == FLOW:
        return scale * start, scale * end
    rate = -scale * (end - start) / dt
    if volume == RATE:
        return rate, rate
    v0 = e.v0_m3[volume] + e.growth_m2[volume] * e.values[e.x_column]
    v1 = e.v0_m3[volume] + e.growth_m2[volume] * sample[2 + e.x_column]
    return rate * v0, rate * v1


@inlined
def steepness(e: Any, k: int) -> float:
    """df/dz of shared term k at the last sample."""
    z, shape = argument(e, k, e.values, 0), e.term_shape[k]
    if shape == ROOT:
        return 0.5 / math.sqrt(max(abs(z), LEAST_Z))
    if shape == HINGE:
        return 1.0 if z > 0.0 else 0.0
    if shape == INVERSE:
        return 1.0 / (z * z)
    return 1.0


@part
def soften(e: Any) -> None:
    """What the rate terms, at theta = 1, store per pressure of their chamber: V scale df/dp."""
    for c in range(e.n_chambers):
        e.softness[c] = 0.0
        for k in range(e.n_terms):
            weight, volume = e.term_weight[k, e.p_column[c]], e.term_volume[k]
            if volume != FLOW and weight != 0.0:
                v = 1.0
                if volume != RATE:
                    v = e.v0_m3[volume] + e.growth_m2[volume] * e.values[e.x_column]
                e.softness[c] += e.term_sign[k, c] * e.term_scale[k] * weight * v * steepness(e, k)


@part
def term_increments(e: Any, sample: FloatArray, dt: float) -> None:
    """Integrals, m3 (carry form: end values), of the shared terms; sample (2 + signals,), SI."""
    for k in range(e.n_terms):
        start, end = term_rates(e, k, sample, dt)
        j = 1 + e.n_chambers + k
        for c in range(e.n_chambers):
            sign = e.term_sign[k, c]
            if e.form != INTEGRAL:
                e.inc[c, j], e.end[c, j] = sign * start, sign * end
            else:
                e.d[c, j] += 0.5 * dt * sign * (start + end)
                if e.gate_sd > 0.0:
                    e.gap[c] -= 0.5 * dt * sign * (start + end) * e.held_terms[k]


@inlined
def mean_terms(e: Any, i: int, iu: int, ip: int) -> tuple[float, float]:
    """Means over the interval of the six Taylor terms of edge i's block (iu, ip), into e.phi.

    Of a proportional map its own.  Exact for the lagged command and linear dp.  Returns the local
    dp at both ends.
    """
    u, p, phi = e.u_border[i], e.dp_border[i], e.phi
    hu, hp = 2.0 / (u[iu + 1] - u[iu]), 2.0 / (p[ip + 1] - p[ip])
    uc, pc = 0.5 * (u[iu + 1] + u[iu]), 0.5 * (p[ip + 1] + p[ip])
    m1, m2, mt = e.moments[i, 0], e.moments[i, 1], e.moments[i, 2]
    eta0, eta1 = (e.dp_pa[i, 0] - pc) * hp, (e.dp_pa[i, 1] - pc) * hp
    phi[0] = 1.0
    phi[1] = (m1 - uc) * hu
    phi[2] = 0.5 * (eta0 + eta1)
    phi[3] = (m2 - 2.0 * uc * m1 + uc * uc) * hu * hu
    phi[4] = (eta0 * eta0 + eta0 * eta1 + eta1 * eta1) / 3.0
    phi[5] = phi[1] * phi[2] + mt * hu * (eta1 - eta0)
    if e.map_basis[i] == PROPORTIONAL:
        phi[0] = m1 / max(abs(u[iu]), abs(u[iu + 1]))
        phi[2], phi[4] = phi[0] * phi[2], phi[0] * phi[4]
    if e.masked[i] != 0:
        for j in range(TERMS):
            phi[j] *= e.mask[i, j]
    return eta0, eta1


@part
def block_increments(
    e: Any, cells: Any, blocks: Any, k: int, i: int, t: float, dt: float, row: bool
) -> None:
    """Integrals (carry form: end values) of open block k's Taylor terms over the interval.

    i: the edge whose command is in it.
    """
    block = blocks[e.open_slot[k]]
    eta0, eta1 = mean_terms(e, i, e.open_cell[k, 0], e.open_cell[k, 1])
    _visit(e, block, t, dt, row)
    if e.form != INTEGRAL:
        _carry_ends(e, i, e.first + TERMS * k, eta0, eta1)
    else:
        _integrals(e, i, e.first + TERMS * k, dt)
        flow_noise(e, i, cells[block.cell].slope, cells[block.cell].missed, dt)
        if e.gate_sd > 0.0:
            _subtract_held(e, cells[block.cell], block, i, dt)


@part
def windowed_increments(
    e: Any, cells: Any, blocks: Any, k: int, i: int, t: float, dt: float, row: bool
) -> None:
    """The same for a block under a window; the visit counts for the block that is home."""
    iu, ip = e.open_cell[k, 0], e.open_cell[k, 1]
    block, at_home = blocks[e.open_slot[k]], iu == e.home[i, 0] and ip == e.home[i, 1]
    if at_home:
        mean_terms(e, i, iu, ip)
        _visit(e, block, t, dt, row)
    mean_windowed(e, i, iu, ip)
    if e.form != INTEGRAL:
        _windowed_ends(e, i, e.first + TERMS * k)
    else:
        _integrals(e, i, e.first + TERMS * k, dt)
        if at_home:
            flow_noise(e, i, cells[block.cell].slope, cells[block.cell].missed, dt)
        if e.gate_sd > 0.0:
            _subtract_held(e, cells[block.cell], block, i, dt)


@inlined
def mean_windowed(e: Any, i: int, iu: int, ip: int) -> None:
    """Means of the windowed terms over the interval, by two Gauss points, kept in e.phi_at."""
    for g in range(2):
        at = 0.5 + (GAUSS if g == 1 else -GAUSS)
        w = e.held_v[i] + (e.start_v[i] - e.held_v[i]) * e.gauss_decay[g]
        dp = e.dp_pa[i, 0] + at * (e.dp_pa[i, 1] - e.dp_pa[i, 0])
        window_axis(e.u_border[i], e.n_u[i], iu, w, e.map_basis[i], e.axis[0])
        window_axis(e.dp_border[i], e.n_dp[i], ip, dp, min(e.map_basis[i], BLENDED), e.axis[1])
        window_terms(e.axis[0], e.axis[1], e.phi_at[g])
    for j in range(TERMS):
        e.phi[j] = 0.5 * (e.phi_at[0, j] + e.phi_at[1, j])
        if e.masked[i] != 0:
            e.phi[j] *= e.mask[i, j]


@inlined
def _visit(e: Any, block: Any, t: float, dt: float, row: bool) -> None:
    block.dwell_s += dt
    block.last_s = t
    if row:
        block.rows += 1
    for j in range(TERMS):
        block.phi_sum[j] += e.phi[j] * dt


@inlined
def _integrals(e: Any, i: int, first: int, dt: float) -> None:
    for c in range(e.n_chambers):
        scale = e.sign[i, c] * e.scale_m3s[i] * dt
        for j in range(TERMS):
            e.d[c, first + j] += scale * e.phi[j]


@part
def _subtract_held(e: Any, cell: Any, block: Any, i: int, dt: float) -> None:
    """Take the flow of the map held from the gap; where it knows nothing, judge nothing.

    Its own error stays the same during a visit: the deviations of the intervals add up.
    """
    if cell.known == 0:
        e.blind = 1
    q, variance = 0.0, HELD_MISFIT * HELD_MISFIT
    for j in range(TERMS):
        q += e.phi[j] * cell.held[j]
        for k in range(TERMS):
            variance += e.phi[j] * block.held_cov[j, k] * e.phi[k]
    flow = e.scale_m3s[i] * dt
    for c in range(e.n_chambers):
        e.gap[c] -= e.sign[i, c] * flow * q
        e.gap_sd[c] += abs(e.sign[i, c]) * flow * math.sqrt(max(0.0, variance))


@inlined
def _carry_ends(e: Any, i: int, first: int, eta0: float, eta1: float) -> None:
    """Start and end values: the regressor runs from phi(u_k, dp_k) to phi(u_k, dp_k+1)."""
    phi, rise = e.phi, 0.5 * (eta1 - eta0)
    for c in range(e.n_chambers):
        scale, start, end = e.sign[i, c] * e.scale_m3s[i], e.inc[c], e.end[c]
        for j in range(TERMS):
            start[first + j], end[first + j] = scale * phi[j], scale * phi[j]
        d_eta, d_eta2 = scale * rise * e.mask[i, 2], scale * rise * (eta0 + eta1) * e.mask[i, 4]
        d_both = scale * rise * phi[1] * e.mask[i, 5]
        start[first + 2], end[first + 2] = start[first + 2] - d_eta, end[first + 2] + d_eta
        start[first + 4], end[first + 4] = start[first + 4] - d_eta2, end[first + 4] + d_eta2
        start[first + 5], end[first + 5] = start[first + 5] - d_both, end[first + 5] + d_both


@inlined
def _windowed_ends(e: Any, i: int, first: int) -> None:
    """Start and end values of the straight line through the two Gauss points."""
    for c in range(e.n_chambers):
        scale = e.sign[i, c] * e.scale_m3s[i]
        for j in range(TERMS):
            half = 0.25 / GAUSS * (e.phi_at[1, j] - e.phi_at[0, j]) * e.mask[i, j]
            e.inc[c, first + j] = scale * (e.phi[j] - half)
            e.end[c, first + j] = scale * (e.phi[j] + half)


@inlined
def flow_noise(e: Any, i: int, slope: float, missed: float, dt: float) -> None:
    """Random walk of the integral: pressure noise through dQ/ddp and missed flow, (m3)^2."""
    period = e.p_period_s if e.p_period_s > 0.0 else dt
    q = (slope * slope * e.dp_var_pa2[i] * period + missed) * dt
    for a in range(e.n_chambers):
        for b in range(e.n_chambers):
            e.cov[a, b] += e.sign[i, a] * e.sign[i, b] * q
