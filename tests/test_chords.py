"""The nodes of a table along one axis, against every chord that there is."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtid.kernels import chords
from rtid.kernels.chords import far_apart
from rtid.maps.lookup import refined
from rtid.plain import FloatArray

N, FINE = 33, 16


def curves(seed: int, columns: int) -> tuple[FloatArray, FloatArray]:
    """Places that are not even, and random walks over them (N, columns)."""
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.1, 1.0, N)), rng.normal(size=(N, columns)).cumsum(axis=0)


def misses(x: FloatArray, exact: FloatArray, start: int, end: int) -> float:
    """What the chord from one place to another misses the most."""
    inner = slice(start, end + 1)
    share = ((x[inner] - x[start]) / (x[end] - x[start]))[:, None]
    return float(np.abs(exact[start] + share * (exact[end] - exact[start]) - exact[inner]).max())


@pytest.fixture(params=["compiled", "python"])
def mode(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "python":
        monkeypatch.setattr(chords, "_farthest", chords._farthest.py_func)
    return str(request.param)


def nodes(mode: str, x: FloatArray, exact: FloatArray, allowed: float) -> list[int]:
    walk: Any = far_apart if mode == "compiled" else far_apart.py_func
    at = np.empty(len(x), np.int64)
    return [int(k) for k in at[: walk(x, exact, allowed, FINE, at)]]


@pytest.mark.parametrize("seed", range(5))
def test_each_node_is_as_far_as_any_chord_goes(mode: str, seed: int) -> None:
    x, exact = curves(seed, 1 + seed % 3)
    at = nodes(mode, x, exact, 1.0)
    assert at[0] == 0 and {FINE, N - 1} <= set(at)
    for start, node in pairwise(at):
        last = FINE if node <= FINE else N - 1
        good = [t for t in range(start + 1, last + 1) if misses(x, exact, start, t) <= 1.0]
        assert node == max(good)


@given(seed=st.integers(0, 2**31), allowed=st.floats(1e-3, 10.0))
@settings(max_examples=50, deadline=None)
def test_what_lies_between_nodes_is_missed_by_no_more(seed: int, allowed: float) -> None:
    x, exact = curves(seed, 2)
    at = refined(x, exact, allowed, FINE)
    assert max(misses(x, exact, a, b) for a, b in pairwise(at)) <= 1.000001 * allowed


def test_a_straight_line_needs_its_ends_alone_and_no_number_ends() -> None:
    x = np.arange(float(N))
    line = np.stack([2.0 * x, -x], axis=1)
    assert refined(x, line, 1e-9, N - 1).tolist() == [0, N - 1]
    assert refined(x, line.T.copy().T, 1e-9, FINE).tolist() == [0, FINE, N - 1]
    assert len(refined(x, np.full((N, 1), np.nan), 1.0, N - 1)) == N
