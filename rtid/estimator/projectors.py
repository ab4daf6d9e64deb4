"""Lapped orthogonal projectors, eq. (12) and Theorem 1 (Coifman and Meyer), and local cosines.

    P+ f(t) = beta(s) [beta(s) f(t) + beta(-s) f(2a - t)]       s = (t - a) / eta
    P- f(t) = beta(-s) [beta(-s) f(t) - beta(s) f(2a - t)]

split f at a into two orthogonal parts that overlap on [a - eta, a + eta] only.  Repeated at the
borders b_0 < ... < b_n, with eta_i + eta_i+1 <= b_i+1 - b_i, they split it into one piece a block,

    P_i = P+ at b_i  after  P- at b_i+1,      sum of all P_i = 1,   P_i P_j = 0 for i != j.

A piece is even about b_i and odd about b_i+1, apart from the window g_i(t) = beta((t - b_i) /
eta_i) beta((b_i+1 - t) / eta_i+1): the local cosines are an orthonormal basis of all pieces.  At
the outer borders b_0 and b_n nothing is split.  There the blocks end sharply, and the last block's
cosines are even about its end, so that a function need not vanish there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rtid.errors import RtidError
from rtid.estimator.windows import overlaps, profile
from rtid.plain import FloatArray

Function = Callable[[FloatArray], FloatArray]
Function2 = Callable[[FloatArray, FloatArray], FloatArray]


class OverlapError(RtidError):
    """Overlaps that meet within a block, or that the samples do not lie symmetrically around."""


def plus(f: Function, a: float = 0.0, eta: float = 1.0) -> Function:
    """P+ f, which vanishes below a - eta and equals f above a + eta."""

    def part(t: FloatArray) -> FloatArray:
        s, mirrored = _local(t, a, eta)
        return profile(s) * (profile(s) * f(t) + profile(-s) * f(mirrored))

    return part


def minus(f: Function, a: float = 0.0, eta: float = 1.0) -> Function:
    """P- f, which equals f below a - eta and vanishes above a + eta."""

    def part(t: FloatArray) -> FloatArray:
        s, mirrored = _local(t, a, eta)
        return profile(-s) * (profile(-s) * f(t) - profile(s) * f(mirrored))

    return part


def piece(f: Function, border: FloatArray, i: int, eta: FloatArray | None = None) -> Function:
    """P_i f of block i; border (n + 1,), eta (n + 1,) half overlaps in units of t, or `overlaps`.

    Raises OverlapError where two overlaps meet within a block.
    """
    eta = _half_overlaps(border, eta)
    if i < len(border) - 2:
        f = minus(f, border[i + 1], eta[i + 1])
    return _cut(plus(f, border[i], eta[i]) if i > 0 else f, border, i)


def piece_2d(
    f: Function2,
    borders: tuple[FloatArray, FloatArray],
    block: tuple[int, int],
    etas: tuple[FloatArray | None, FloatArray | None] = (None, None),
) -> Function2:
    """Tensor product of the projectors for block (i, j); borders (n + 1,) in units of x, y."""

    def along_second(x: FloatArray, y: FloatArray) -> FloatArray:
        return piece(lambda t: f(x, t), borders[1], block[1], etas[1])(y)

    def part(x: FloatArray, y: FloatArray) -> FloatArray:
        x, y = np.broadcast_arrays(x, y)
        return piece(lambda t: along_second(t, y), borders[0], block[0], etas[0])(x)

    return part


def plus_samples(values: FloatArray, t: FloatArray, a: float = 0.0, eta: float = 1.0) -> FloatArray:
    """P+ along the last axis of values (..., n), any unit, at t (n,) symmetrical around a.

    Raises OverlapError where the samples within [a - eta, a + eta] have no mirror images.
    """
    s, mirrored = _mirror_samples(values, t, a, eta)
    return np.asarray(profile(s) * (profile(s) * values + profile(-s) * mirrored))


def minus_samples(
    values: FloatArray, t: FloatArray, a: float = 0.0, eta: float = 1.0
) -> FloatArray:
    """P- along the last axis of values (..., n), any unit, as `plus_samples`."""
    s, mirrored = _mirror_samples(values, t, a, eta)
    return np.asarray(profile(-s) * (profile(-s) * values - profile(s) * mirrored))


def pieces_samples(
    values: FloatArray, t: FloatArray, border: FloatArray, eta: FloatArray | None = None
) -> FloatArray:
    """All pieces (blocks, ..., n) of values (..., n), in their unit; they sum to them inside."""
    eta = _half_overlaps(border, eta)
    pieces, rest = [], np.where((t >= border[0]) & (t <= border[-1]), values, 0.0)
    for k in range(1, len(border) - 1):
        pieces.append(minus_samples(rest, t, border[k], eta[k]))
        rest = plus_samples(rest, t, border[k], eta[k])
    return np.stack([*pieces, rest])


def pieces_samples_2d(
    values: FloatArray, t: tuple[FloatArray, FloatArray], borders: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """All pieces (blocks of u, blocks of dp, n, m) of values (n, m) at the grid of t[0] x t[1]."""
    along_dp = pieces_samples(values, t[1], borders[1])
    both = pieces_samples(np.swapaxes(along_dp, -1, -2), t[0], borders[0])
    return np.swapaxes(both, -1, -2)


def window(border: FloatArray, i: int, t: FloatArray, eta: FloatArray | None = None) -> FloatArray:
    """g_i(t) of block i, t (...), dimensionless; the squares of all sum to 1 inside."""
    eta, n = _half_overlaps(border, eta), len(border) - 1
    left = profile((t - border[i]) / eta[i]) if i > 0 else 1.0
    right = profile((border[i + 1] - t) / eta[i + 1]) if i < n - 1 else 1.0
    return _cut(lambda _: np.asarray(left * right + 0.0 * t), border, i)(t)


def cosine(border: FloatArray, i: int, k: int, t: FloatArray) -> FloatArray:
    """The k-th cosine of block i without its window at t (...), of unit norm over [b_i, b_i+1]."""
    width = border[i + 1] - border[i]
    last = i == len(border) - 2
    scale = np.sqrt((1.0 if last and k == 0 else 2.0) / width)
    return np.asarray(
        scale * np.cos(np.pi * (k + (0.0 if last else 0.5)) * (t - border[i]) / width)
    )


def local_cosine(
    border: FloatArray, i: int, k: int, t: FloatArray, eta: FloatArray | None = None
) -> FloatArray:
    """g_i(t) sqrt(2 / width) cos(pi (k + 1/2) (t - b_i) / width), orthonormal for all i and k.

    The last block has cos(pi k ...) instead, see above.  t (...) in the unit of border (n + 1,).
    """
    return window(border, i, t, eta) * cosine(border, i, k, t)


def folded(f: Function, border: FloatArray, i: int, eta: FloatArray | None = None) -> Function:
    """f folded into block i of border (n + 1,), in f's unit: what the block's cosines see of it."""
    inside = piece(f, border, i, eta)

    def part(t: FloatArray) -> FloatArray:
        return inside(t) / window(border, i, t, eta)  # at least sqrt(1/2) within the block

    return part


def unfolded(h: Function, border: FloatArray, i: int, eta: FloatArray | None = None) -> Function:
    """The piece, in h's unit, whose folding is h on [b_i, b_i+1] of border (n + 1,)."""

    def part(t: FloatArray) -> FloatArray:
        low, high = border[i], border[i + 1]
        inner = np.where(t < low, 2 * low - t, np.where(t > high, 2 * high - t, t))
        sign = np.where(t > high, -1.0, 1.0)
        return sign * window(border, i, t, eta) * h(np.clip(inner, low, high))

    return part


def coefficients(
    f: Function, border: FloatArray, i: int, count: int, eta: FloatArray | None = None
) -> FloatArray:
    """<f, local cosine k> (count,) of block i, in units of f, by Gauss quadrature."""
    low, high, reach = border[i], border[i + 1], _half_overlaps(border, eta)
    cuts = np.unique(np.clip([low, low + reach[i], high - reach[i + 1], high], low, high))
    nodes, weights = np.polynomial.legendre.leggauss(count + 40)
    half_width = 0.5 * np.diff(cuts)[:, None]
    t = (cuts[:-1, None] + half_width * (1.0 + nodes)).ravel()
    values = (half_width * weights).ravel() * folded(f, border, i, eta)(t)
    return np.array([values @ cosine(border, i, k, t) for k in range(count)])


def _local(t: FloatArray, a: float, eta: float) -> tuple[FloatArray, FloatArray]:
    """(t - a) / eta, and the mirror image of t where that matters: within the overlap."""
    s = (t - a) / eta
    return s, np.where(np.abs(s) < 1.0, 2.0 * a - t, t)


def _mirror_samples(
    values: FloatArray, t: FloatArray, a: float, eta: float
) -> tuple[FloatArray, FloatArray]:
    s, mirrored = (t - a) / eta, values.copy()
    within = np.flatnonzero(np.abs(s) < 1.0 - 1e-9)
    if not np.allclose(s[within], -s[within[::-1]], rtol=0.0, atol=1e-6):
        raise OverlapError(
            f"the samples are not symmetric around {a:g} +- {eta:g}",
            "choose a uniform grid with a sample, or the middle of two, at each border",
        )
    mirrored[..., within] = values[..., within[::-1]]
    return s, mirrored


def _half_overlaps(border: FloatArray, eta: FloatArray | None) -> FloatArray:
    """eta as given or by default; the outer ones are not used."""
    if eta is None:
        return overlaps(border)
    inner = np.concatenate([[0.0], eta[1:-1], [0.0]])
    if not (inner[1:-1] > 0).all():
        raise OverlapError("a half overlap is not positive", "give eta > 0 at every inner border")
    if (inner[:-1] + inner[1:] > np.diff(border) * (1 + 1e-12)).any():
        i = int(np.argmax(inner[:-1] + inner[1:] - np.diff(border)))
        raise OverlapError(
            f"the overlaps of block {i} meet: {inner[i]:g} + {inner[i + 1]:g} is more than its"
            f" width {border[i + 1] - border[i]:g}",
            "make the half overlaps smaller",
        )
    return np.asarray(eta, float)


def _cut(f: Function, border: FloatArray, i: int) -> Function:
    """The function within the outer borders, 0 beyond."""
    if 0 < i < len(border) - 2:
        return f
    return lambda t: np.where((t >= border[0]) & (t <= border[-1]), f(t), 0.0)
