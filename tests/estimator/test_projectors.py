"""Theorem 1 in figures: the lapped projectors, their repetition over borders, local cosines."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtid.estimator.projectors import (
    Function,
    OverlapError,
    coefficients,
    cosine,
    folded,
    local_cosine,
    minus,
    minus_samples,
    piece,
    piece_2d,
    pieces_samples,
    pieces_samples_2d,
    plus,
    plus_samples,
    unfolded,
    window,
)
from rtid.estimator.windows import overlaps, profile, rising
from rtid.plain import FloatArray

BORDER = np.array([0.0, 1.0, 1.25, 1.5, 3.0, 7.0])
NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)

a_seed = st.integers(0, 2**32 - 1)


def wave(seed: int) -> Function:
    """A smooth function without any symmetry."""
    rng = np.random.default_rng(seed)
    size, rate, phase = rng.uniform(-1, 1, 5), rng.uniform(0.2, 4, 5), rng.uniform(0, 6, 5)
    return lambda t: np.asarray(np.cos(np.multiply.outer(t, rate) + phase) @ size)


def inner(f: Function, g: Function, cuts: FloatArray) -> float:
    """Integral of f g; both are smooth between the cuts."""
    half = 0.5 * np.diff(cuts)[:, None]
    t = (cuts[:-1, None] + half * (1.0 + NODES)).ravel()
    return float((half * WEIGHTS).ravel() @ (f(t) * g(t)))


def cuts(border: FloatArray, eta: FloatArray) -> FloatArray:
    """Borders and ends of the overlaps: between them everything is analytic."""
    inside = border[1:-1]
    edges = np.concatenate([border, inside - eta[1:-1], inside + eta[1:-1]])
    return np.unique(edges)


def spacing(seed: int) -> tuple[FloatArray, FloatArray]:
    """Random borders with random overlaps that just do not meet."""
    rng = np.random.default_rng(seed)
    width = 10.0 ** rng.uniform(-1, 1, rng.integers(2, 7))
    border = np.append(0.0, np.cumsum(width)) + rng.uniform(-5, 5)
    eta, left = np.zeros(len(border)), width.copy()
    for k in range(1, len(border) - 1):
        eta[k] = rng.uniform(0.05, 0.5) * min(left[k - 1], width[k])
        left[k] -= eta[k]
    eta[[0, -1]] = 1.0
    return border, eta


def test_profile_is_that_of_the_published_map() -> None:
    t = np.linspace(-1.5, 1.5, 301)
    np.testing.assert_allclose(profile(t) ** 2, rising(t), atol=1e-16)
    np.testing.assert_allclose(profile(t) ** 2 + profile(-t) ** 2, 1.0, atol=4e-16)
    assert (np.diff(profile(t)) >= 0).all()
    assert (profile(np.array([-1.0, 1.0])) == [0.0, 1.0]).all()


@given(a_seed, st.floats(-3, 3), st.floats(0.01, 5))
@settings(max_examples=60, deadline=None)
def test_theorem_1(seed: int, a: float, eta: float) -> None:
    f, g = wave(seed), wave(seed + 1)
    t = a + eta * np.linspace(-2, 2, 401)
    up, down = plus(f, a, eta), minus(f, a, eta)

    def close(x: FloatArray, y: FloatArray | float) -> None:
        np.testing.assert_allclose(x, y, rtol=0.0, atol=1e-13)

    close(up(t) + down(t), f(t))
    close(plus(up, a, eta)(t), up(t))
    close(minus(down, a, eta)(t), down(t))
    close(plus(down, a, eta)(t), 0.0)
    close(minus(up, a, eta)(t), 0.0)
    assert (up(t)[t < a - 1.001 * eta] == 0).all() and (down(t)[t > a + 1.001 * eta] == 0).all()
    close(up(t)[t >= a + eta], f(t)[t >= a + eta])
    all_cuts = a + eta * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    size = 4 * eta
    assert abs(inner(up, g, all_cuts) - inner(f, plus(g, a, eta), all_cuts)) < 1e-11 * size
    assert abs(inner(up, minus(g, a, eta), all_cuts)) < 1e-11 * size


@pytest.mark.parametrize("shift", [0.0, 0.5])  # a sample at the border, or the middle of two
def test_samples_follow_the_functions(shift: float) -> None:
    t = np.linspace(0.0, 4.0, 401) + 0.01 * shift
    f = wave(3)
    np.testing.assert_allclose(plus_samples(f(t), t, 2.0, 0.7), plus(f, 2.0, 0.7)(t), atol=1e-13)
    np.testing.assert_allclose(minus_samples(f(t), t, 2.0, 0.7), minus(f, 2.0, 0.7)(t), atol=1e-13)


def test_samples_without_mirror_images_are_refused() -> None:
    t = np.linspace(0, 4, 401)
    with pytest.raises(OverlapError, match=r"not symmetric around 2\.0033"):
        plus_samples(t, t, 2.0033, 0.5)


@given(a_seed)
@settings(max_examples=40, deadline=None)
def test_pieces_sum_to_the_signal_and_are_orthogonal(seed: int) -> None:
    border, eta = spacing(seed)
    f = wave(seed)
    t = np.linspace(border[0], border[-1], 1001)
    parts = [piece(f, border, i, eta) for i in range(len(border) - 1)]
    np.testing.assert_allclose(sum(p(t) for p in parts), f(t), rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        sum(window(border, i, t, eta) ** 2 for i in range(len(parts))), 1.0, atol=1e-14
    )
    at = cuts(border, eta)
    gram = np.array([[inner(p, q, at) for q in parts] for p in parts])
    energy = inner(f, f, at)
    np.testing.assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-11 * energy)
    assert np.trace(gram) == pytest.approx(energy, rel=1e-11)
    for i, p in enumerate(parts):
        outside = (t < border[i] - (i > 0) * eta[i]) | (
            t > border[i + 1] + (i < len(parts) - 1) * eta[i + 1]
        )
        assert (p(t)[outside] == 0).all()
        np.testing.assert_allclose(piece(p, border, i, eta)(t), p(t), rtol=0, atol=1e-13)


def test_pieces_of_samples() -> None:
    t = np.linspace(0, 7, 2801)
    rng = np.random.default_rng(1)
    values = rng.standard_normal((3, len(t)))
    parts = pieces_samples(values, t, BORDER)
    assert parts.shape == (5, 3, len(t))
    np.testing.assert_allclose(parts.sum(axis=0), values, atol=1e-14)
    gram = np.einsum("ikt,jkt->kij", parts, parts)
    np.testing.assert_allclose(gram, gram * np.eye(5), atol=1e-10)
    f = wave(5)
    for i, part in enumerate(pieces_samples(f(t), t, BORDER)):
        np.testing.assert_allclose(part, piece(f, BORDER, i)(t), atol=1e-13)


def test_two_dimensions() -> None:
    x, y = np.linspace(0, 7, 281), np.linspace(-1, 3, 161)
    second = np.array([-1.0, 0.0, 0.5, 3.0])
    f, g = wave(7), wave(8)
    values = f(x)[:, None] * g(y) + np.cos(x[:, None] * y)
    parts = pieces_samples_2d(values, (x, y), (BORDER, second))
    assert parts.shape == (5, 3, 281, 161)
    np.testing.assert_allclose(parts.sum(axis=(0, 1)), values, atol=1e-13)
    flat = parts.reshape(15, -1)
    gram = flat @ flat.T
    np.testing.assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-9)
    for i, j in ((0, 0), (2, 1), (4, 2)):
        one = piece_2d(lambda a, b: f(a) * g(b) + np.cos(a * b), (BORDER, second), (i, j))
        np.testing.assert_allclose(one(x[:, None], y), parts[i, j], atol=1e-13)
        product = piece(f, BORDER, i)(x)[:, None] * piece(g, second, j)(y)
        apart = piece_2d(lambda a, b: f(a) * g(b), (BORDER, second), (i, j))
        np.testing.assert_allclose(apart(x[:, None], y), product, atol=1e-13)


@pytest.mark.parametrize("border", [BORDER, np.array([0.0, 2.0]), np.array([-1.0, 0.0, 5.0])])
def test_gram_matrix_of_the_local_cosines_is_the_identity(border: FloatArray) -> None:
    eta = overlaps(border, 0.5)
    at = cuts(border, eta)
    half = 0.5 * np.diff(at)[:, None]
    t, weight = (at[:-1, None] + half * (1 + NODES)).ravel(), (half * WEIGHTS).ravel()
    blocks = range(len(border) - 1)
    every = np.stack([local_cosine(border, i, k, t, eta) for i in blocks for k in range(8)])
    np.testing.assert_allclose((every * weight) @ every.T, np.eye(len(every)), atol=1e-10)


@given(a_seed)
@settings(max_examples=30, deadline=None)
def test_folding_is_what_the_cosines_see(seed: int) -> None:
    border, eta = spacing(seed)
    f, i = wave(seed), seed % (len(border) - 1)
    at = cuts(border, eta)
    found = coefficients(f, border, i, 6, eta)
    direct = [
        inner(f, lambda t, k=k: local_cosine(border, i, k, t, eta), at)  # type: ignore[misc]
        for k in range(6)
    ]
    np.testing.assert_allclose(found, direct, atol=1e-11 * np.ptp(border))
    t = np.linspace(border[0], border[-1], 501)
    back = unfolded(folded(f, border, i, eta), border, i, eta)
    np.testing.assert_allclose(back(t), piece(f, border, i, eta)(t), rtol=0, atol=1e-12)


EQUAL = np.linspace(0.0, 7.0, 8)
WIDEST = overlaps(EQUAL, 0.5)


def error(f: Function, count: int, t: FloatArray) -> FloatArray:
    """What `count` local cosines per block miss of f at t."""
    total = np.zeros(len(t))
    for i in range(len(EQUAL) - 1):
        for k, c in enumerate(coefficients(f, EQUAL, i, count, WIDEST)):
            total += c * local_cosine(EQUAL, i, k, t, WIDEST)
    return np.asarray(total - f(t))


def test_expansion_of_a_smooth_function_converges() -> None:
    """As count^-5/2: beta has one continuous derivative.  At the outer ends, where no window falls
    and the cosines are even although the function is not, as count^-3/2.
    """
    t = np.linspace(1.6, 5.4, 3001)
    missed = [float(np.abs(error(wave(11), n, t)).max()) for n in (4, 8, 16, 32)]
    assert missed[3] < 5e-4
    assert all(a / b > 4 for a, b in pairwise(missed))
    at_end = np.linspace(0.0, 1.4, 3001)
    ends = [float(error(wave(11), n, at_end).std()) for n in (8, 16, 32)]
    assert all(1.7 < a / b < 3.5 for a, b in pairwise(ends))


def test_expansion_of_a_dead_band_converges_and_its_ripple_stays_local() -> None:
    """As count^-3/2 in the mean square; in blocks without the corner as a smooth function."""
    t = np.linspace(1.6, 5.4, 3001)

    def kink(x: FloatArray) -> FloatArray:
        return np.maximum(x - 2.6, 0.0)

    missed = [error(kink, n, t) for n in (4, 8, 16, 32)]
    assert all(1.7 < a.std() / b.std() < 6 for a, b in pairwise(missed))
    assert missed[3].std() < 1e-3
    elsewhere = (t < 1.5) | (t > 3.5)  # beyond the block of the corner and its overlaps
    assert np.abs(missed[3])[elsewhere].max() < 0.2 * np.abs(missed[3]).max()


def test_cosines_of_one_block_are_orthonormal_over_it() -> None:
    t = BORDER[3] + 0.5 * (BORDER[4] - BORDER[3]) * (1 + NODES)
    every = np.stack([cosine(BORDER, 3, k, t) for k in range(10)])
    gram = (every * WEIGHTS * 0.5 * (BORDER[4] - BORDER[3])) @ every.T
    np.testing.assert_allclose(gram, np.eye(10), atol=1e-13)


def test_overlaps_that_meet_are_refused() -> None:
    with pytest.raises(OverlapError, match=r"overlaps of block 1 meet: 0\.2 \+ 0\.1"):
        piece(wave(0), BORDER, 0, np.array([1.0, 0.2, 0.1, 0.1, 0.1, 1.0]))
    with pytest.raises(OverlapError, match="not positive"):
        piece(wave(0), BORDER, 0, np.zeros(6))
