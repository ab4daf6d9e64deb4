"""The two forms of the regression as linear filters of the columns: what makes a row, what fades.

Integral form (design: one row per measured position).  The gap d = z - m between a column's
integral and its prediction is followed by a Kalman whitener: position noise (with the pressure
noise that enters through V dP and through what the terms store) is white with covariance R, flow
noise (pressure noise through dQ/ddp) is a random walk with covariance Q per step:

    P <- P + Q;  S = P + R;  row = L^-1 d, S = L L';  d <- R S^-1 d;  P <- P S^-1 R

Carry form, eq. (10)-(11): every column passes H_f; a row is the filter's output at the row
instants, divided by the Cholesky factor of the two chambers' position noise; d is the state of the
filter.
"""

from __future__ import annotations

import math
from typing import Any

from rtid.kernels.jit import inlined, part
from rtid.kernels.layout import ROWS, TERMS
from rtid.kernels.local import add_products


@part
def start_whitener(e: Any) -> None:
    """The first position is known as well as it was measured: P = R."""
    for c in range(e.n_chambers):
        e.gap[c], e.gap_sd[c] = 0.0, 0.0
        for k in range(3):
            e.echo[c, k] = 0.0
    for a in range(e.n_chambers):
        for b in range(e.n_chambers):
            e.cov[a, b] = position_noise(e, a, b)


@inlined
def position_noise(e: Any, a: int, b: int) -> float:
    """Covariance R of the rows' white noise, m6: one x for both chambers, one p for each."""
    r = e.area_m2[a] * e.area_m2[b] * e.x_var_m2
    if a == b:
        v = e.v0_m3[a] + e.growth_m2[a] * e.values[e.x_column]
        r += (v * e.compliance[a] + e.softness[a]) ** 2 * e.p_var_pa2[a]
    return r


@inlined
def innovations(e: Any, d: Any, more_a: float, more_b: float) -> tuple[float, float]:
    """L^-1 d (chambers,) of a column, L L' = S + diag(more); the second is 0 for one chamber."""
    s00 = e.cov[0, 0] + position_noise(e, 0, 0) + more_a
    first = d[0] / math.sqrt(s00)
    if e.n_chambers == 1:
        return first, 0.0
    s01, s11 = e.cov[0, 1] + position_noise(e, 0, 1), e.cov[1, 1] + position_noise(e, 1, 1) + more_b
    return first, (d[1] - s01 / s00 * d[0]) / math.sqrt(s11 - s01 * s01 / s00)


@inlined
def fade(e: Any, d: Any) -> None:
    """d <- R S^-1 d (chambers,) of one column at a row, in place."""
    r00 = position_noise(e, 0, 0)
    s00 = e.cov[0, 0] + r00
    if e.n_chambers == 1:
        d[0] *= r00 / s00
        return
    r01, r11 = position_noise(e, 0, 1), position_noise(e, 1, 1)
    s01, s11 = e.cov[0, 1] + r01, e.cov[1, 1] + r11
    det = s00 * s11 - s01 * s01
    g0, g1 = (s11 * d[0] - s01 * d[1]) / det, (s00 * d[1] - s01 * d[0]) / det
    d[0], d[1] = r00 * g0 + r01 * g1, r01 * g0 + r11 * g1


@inlined
def _column_variance(e: Any, c: int) -> float:
    """Variance of the noise n in column -V dP of chamber c, m6."""
    w = (e.v0_m3[c] + e.growth_m2[c] * e.values[e.x_column]) * e.compliance[c]
    return float(w * w * e.p_var_pa2[c])


@inlined
def _add_column_noise(
    e: Any, c: int, k00: float, k01: float, k10: float, k11: float, det: float
) -> None:
    """Add what pressure noise adds on average to the square of column -V dP, beyond its signal.

    Its row is L^-1 (n u_c - m), u_c the unit vector of its chamber, where the prediction m repeats
    past noise: m <- k m + (I - k) u_c n, k = R S^-1, so its covariance E <- k E k' + ...  The same
    n also enters through dQ/ddp, but even in time where n - n_before is odd: they share nothing.
    """
    v, echo = _column_variance(e, c), e.echo[c]
    a = (1.0 - k00) if c == 0 else -k01
    b = -k10 if c == 0 else (1.0 - k11)
    e00, e01, e11 = echo[0], echo[1], echo[2]
    x00 = e00 + (v if c == 0 else 0.0)
    x11 = e11 + (v if c == 1 else 0.0)
    # S^-1 = [[s11, -s01], [-s01, s00]] det, with the whitener's S kept in e.innovation
    S = e.innovation
    e.noise_gram[c] += det * (S[2] * x00 - 2.0 * S[1] * e01 + S[0] * x11)
    echo[0] = k00 * k00 * e00 + 2.0 * k00 * k01 * e01 + k01 * k01 * e11 + a * a * v
    echo[1] = k00 * k10 * e00 + (k00 * k11 + k01 * k10) * e01 + k01 * k11 * e11 + a * b * v
    echo[2] = k10 * k10 * e00 + 2.0 * k10 * k11 * e01 + k11 * k11 * e11 + b * b * v


@inlined
def over(
    c00: float, c01: float, c11: float, s00: float, s01: float, s11: float, det: float
) -> tuple[float, float, float, float]:
    """C S^-1 of two symmetric matrices, row by row; det = 1 / (s00 s11 - s01^2)."""
    return (
        (c00 * s11 - c01 * s01) * det,
        (c01 * s00 - c00 * s01) * det,
        (c01 * s11 - c11 * s01) * det,
        (c11 * s00 - c01 * s01) * det,
    )


@part
def integral_row_one(e: Any) -> None:
    """Row and decay for one chamber."""
    d, row, n = e.d, e.row, e.width
    r = position_noise(e, 0, 0)
    s = e.cov[0, 0] + r
    scale, k = 1.0 / math.sqrt(s), r / s
    for j in range(n):
        row[0, j] = scale * d[0, j]
        d[0, j] *= k
    v = _column_variance(e, 0)
    e.noise_gram[0] += (v + e.echo[0, 0]) / s
    e.echo[0, 0] = k * k * e.echo[0, 0] + (1.0 - k) ** 2 * v
    e.cov[0, 0] *= k
    e.ring_det *= k
    e.counters[ROWS] += 1
    e.rows += 1.0
    add_products(e, 1)


@part
def integral_row_two(e: Any) -> None:
    """Rows and decay for two chambers that share the noise of x: whitened jointly."""
    d, row, cov, n = e.d, e.row, e.cov, e.width
    r00, r01, r11 = position_noise(e, 0, 0), position_noise(e, 0, 1), position_noise(e, 1, 1)
    s00, s01, s11 = cov[0, 0] + r00, cov[0, 1] + r01, cov[1, 1] + r11
    i0 = 1.0 / math.sqrt(s00)
    half = s01 * i0
    i1 = 1.0 / math.sqrt(s11 - half * half)
    det = 1.0 / (s00 * s11 - s01 * s01)
    k00, k01, k10, k11 = over(r00, r01, r11, s00, s01, s11, det)
    for j in range(n):
        d0, d1 = d[0, j], d[1, j]
        row[0, j] = i0 * d0
        row[1, j] = i1 * (d1 - half * i0 * d0)
        d[0, j] = k00 * d0 + k01 * d1
        d[1, j] = k10 * d0 + k11 * d1
    e.innovation[0], e.innovation[1], e.innovation[2] = s00, s01, s11
    for c in range(2):
        _add_column_noise(e, c, k00, k01, k10, k11, det)
    p00, p01, p11 = cov[0, 0], cov[0, 1], cov[1, 1]
    cov[0, 0] = k00 * p00 + k01 * p01
    cov[1, 1] = k10 * p01 + k11 * p11
    cov[0, 1] = 0.5 * (k00 * p01 + k01 * p11 + k10 * p00 + k11 * p01)
    cov[1, 0] = cov[0, 1]
    e.ring_det *= k00 * k11 - k01 * k10
    e.counters[ROWS] += 1
    e.rows += 1.0
    add_products(e, 2)


@part
def carry_step(e: Any) -> None:
    """All filters over one interval: x+ = a x + b [start, end] per chamber and column."""
    a, b, d, inc, end = e.filter_a, e.filter_b, e.d, e.inc, e.end
    n, used = e.width, e.first + TERMS * e.n_open
    a00, a01, a10, a11 = a[0, 0], a[0, 1], a[1, 0], a[1, 1]
    b00, b01, b10, b11 = b[0, 0], b[0, 1], b[1, 0], b[1, 1]
    for c in range(e.n_chambers):
        output, rate, first, last = d[2 * c], d[2 * c + 1], inc[c], end[c]
        for j in range(n):
            x0, x1 = output[j], rate[j]
            output[j] = a00 * x0 + a01 * x1
            rate[j] = a10 * x0 + a11 * x1
        for j in range(used):  # first = last = 0 on the ring
            output[j] += b00 * first[j] + b01 * last[j]
            rate[j] += b10 * first[j] + b11 * last[j]
    e.ring_det *= a00 * a11 - a01 * a10


@part
def carry_row(e: Any) -> None:
    """Rows at a row instant: outputs of the filters, weighted by the position noise."""
    d, row, n = e.d, e.row, e.width
    i0 = 1.0 / math.sqrt(position_noise(e, 0, 0))
    for j in range(n):
        row[0, j] = i0 * d[0, j]
    if e.n_chambers == 2:
        c = position_noise(e, 0, 1) * i0
        i1 = 1.0 / math.sqrt(position_noise(e, 1, 1) - c * c)
        for j in range(n):
            row[1, j] = i1 * (d[2, j] - c * i0 * d[0, j])
    e.counters[ROWS] += 1
    e.rows += 1.0
    add_products(e, e.n_chambers)
