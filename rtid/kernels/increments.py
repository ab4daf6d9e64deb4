"""What one interval adds to the columns of eq. (14), and to the noise that weighs them.

e, cells and blocks are records or record arrays of `layout` and are changed in place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtid.kernels.jit import inlined, part
from rtid.kernels.layout import CARRY, TERMS

FloatArray = NDArray[np.float64]


@inlined
def shared_increments(e: Any, sample: FloatArray, dt: float) -> None:
    """y: s A dx; theta_beta: -V dP (scaled by the nominal compliance), exact for linear x and P.

    Carry form: the rates at both ends of the interval instead of the integrals.
    """
    x0, x1 = e.values[e.x_column], sample[2 + e.x_column]
    for c in range(e.n_chambers):
        dx = e.area_m2[c] * (x1 - x0)
        dp = -e.compliance[c] * (sample[2 + e.p_column[c]] - e.values[e.p_column[c]])
        v0, v1 = e.v0_m3[c] + e.area_m2[c] * x0, e.v0_m3[c] + e.area_m2[c] * x1
        if e.form == CARRY:
            e.inc[c, 0], e.end[c, 0] = dx / dt, dx / dt
            e.inc[c, 1 + c], e.end[c, 1 + c] = dp * v0 / dt, dp * v1 / dt
        else:
            e.d[c, 0] += dx
            e.d[c, 1 + c] += 0.5 * (v0 + v1) * dp


@inlined
def term_flow(e: Any, k: int, values: FloatArray, first: int) -> float:
    """Flow of shared term k for theta = 1; the signals stand in values from `first` on."""
    flow = e.term_constant[k]
    for j in range(e.n_signals):
        flow += e.term_weight[k, j] * values[first + j]
    return float(flow)


@part
def term_increments(e: Any, sample: FloatArray, dt: float) -> None:
    """Integrals (carry form: end values) of the shared terms, linear between samples."""
    for k in range(e.n_terms):
        start, end = term_flow(e, k, e.values, 0), term_flow(e, k, sample, 2)
        j = 1 + e.n_chambers + k
        for c in range(e.n_chambers):
            sign = e.term_sign[k, c]
            if e.form == CARRY:
                e.inc[c, j], e.end[c, j] = sign * start, sign * end
            else:
                e.d[c, j] += 0.5 * dt * sign * (start + end)


@inlined
def mean_terms(e: Any, i: int) -> tuple[float, float]:
    """Means over the interval of the six terms of edge i's current block, into e.phi.

    Exact for the lagged command and linear dp.  Returns the local dp at both ends.
    """
    u, p, phi = e.u_border[i], e.dp_border[i], e.phi
    iu, ip = e.cell[i, 0], e.cell[i, 1]
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
    return eta0, eta1


@part
def block_increments(
    e: Any, cells: Any, blocks: Any, k: int, t: float, dt: float, row: bool
) -> None:
    """Integrals (carry form: end values) of the six terms of open block k over the interval."""
    i = e.open_edge[k]
    block = blocks[e.open_slot[k]]
    eta0, eta1 = mean_terms(e, i)
    phi, first = e.phi, e.first + TERMS * k
    block.dwell_s += dt
    block.last_s = t
    if row:
        block.rows += 1
    for j in range(TERMS):
        block.phi_sum[j] += phi[j] * dt
    if e.form == CARRY:
        _carry_ends(e, i, first, eta0, eta1)
    else:
        for c in range(e.n_chambers):
            scale = e.sign[i, c] * e.scale_m3s[i] * dt
            for j in range(TERMS):
                e.d[c, first + j] += scale * phi[j]
        flow_noise(e, i, cells[block.cell].slope, dt)


@inlined
def _carry_ends(e: Any, i: int, first: int, eta0: float, eta1: float) -> None:
    """Start and end values: the regressor runs from phi(u_k, dp_k) to phi(u_k, dp_k+1)."""
    phi, rise = e.phi, 0.5 * (eta1 - eta0)
    for c in range(e.n_chambers):
        scale, start, end = e.sign[i, c] * e.scale_m3s[i], e.inc[c], e.end[c]
        for j in range(TERMS):
            start[first + j], end[first + j] = scale * phi[j], scale * phi[j]
        d_eta, d_eta2, d_both = scale * rise, scale * rise * (eta0 + eta1), scale * rise * phi[1]
        start[first + 2], end[first + 2] = start[first + 2] - d_eta, end[first + 2] + d_eta
        start[first + 4], end[first + 4] = start[first + 4] - d_eta2, end[first + 4] + d_eta2
        start[first + 5], end[first + 5] = start[first + 5] - d_both, end[first + 5] + d_both


@inlined
def flow_noise(e: Any, i: int, slope: float, dt: float) -> None:
    """Random walk of the integral: pressure noise through dQ/ddp, (m3)^2 per step."""
    period = e.p_period_s if e.p_period_s > 0.0 else dt
    q = slope * slope * e.dp_var_pa2[i] * period * dt
    for a in range(e.n_chambers):
        for b in range(e.n_chambers):
            e.cov[a, b] += e.sign[i, a] * e.sign[i, b] * q
