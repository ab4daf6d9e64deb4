"""What is late is late by a time: over uneven steps, and behind gaps."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtid.diagnose.fit import one_pass, prepare
from rtid.diagnose.revision import Revision
from rtid.effects.instants import Instants
from rtid.effects.laws.timing import TIMINGS, delayed, lagged, second_order
from rtid.kernels.engine import GAP_FLAG
from rtid.model import Machine
from rtid.plain import FloatArray
from tests.diagnose.records import record

KEPT = (0, 1, 4, 6, 10, 11, 16)  # of each 20 samples: messages of 5, 10 and 20 ms in one record
MAX_GAP_S, FINE_S = 0.05, 1e-4


def instants_of(t_s: FloatArray, gaps: tuple[int, ...] = ()) -> Instants:
    chunk = np.column_stack([t_s, np.zeros(len(t_s))])
    chunk[list(gaps), 1] = GAP_FLAG
    return Instants.of(chunk, MAX_GAP_S)


def rows_every(milliseconds: list[int]) -> FloatArray:
    return 1e-3 * np.cumsum([0, *milliseconds])


def finely(
    t_s: FloatArray, u: FloatArray, law: Callable[[FloatArray, float], FloatArray]
) -> FloatArray:
    """Means over the intervals of a held command that goes through a law in steps of 0.1 ms."""
    ends = np.append(t_s, t_s[-1] + np.median(np.diff(t_s)))
    at = np.rint(ends / FINE_S).astype(int)
    out = law(np.repeat(u, np.diff(at)), FINE_S)
    return np.array([out[a - at[0] : b - at[0]].mean() for a, b in pairwise(at)])


@given(st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=40), st.floats(1e-4, 0.03))
def test_even_samples_go_through_as_they_are(u: list[float], late_s: float) -> None:
    instants = instants_of(rows_every([1] * (len(u) - 1)))
    out = instants.over(np.array(u), lambda even: delayed(even, instants.even_s, (late_s,)))
    assert np.array_equal(out, delayed(np.array(u), instants.step_s, (late_s,)))


@given(st.integers(0, 10**6), st.integers(0, 30))
def test_a_delay_over_uneven_steps_is_that_of_fine_ones(seed: int, late_ms: int) -> None:
    rng = np.random.default_rng(seed)
    t_s = rows_every([1, 3, *rng.choice([1, 1, 2, 3, 5], 60).tolist()])
    u, late_s = np.cumsum(rng.standard_normal(len(t_s))), 1e-3 * late_ms
    instants = instants_of(t_s)
    out = instants.over(u, lambda even: delayed(even, instants.even_s, (late_s,)))
    expected = finely(t_s, u, lambda even, step_s: delayed(even, step_s, (late_s,)))
    assert out == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    "law",
    [lambda u, h: lagged(u, h, (8e-3,)), lambda u, h: second_order(u, h, (200.0, 0.7))],
    ids=["lag", "second order"],
)
def test_a_lag_over_uneven_steps_is_that_of_fine_ones(
    law: Callable[[FloatArray, float], FloatArray],
) -> None:
    rng = np.random.default_rng(5)
    t_s = rows_every(rng.choice([1, 2, 3, 4, 5], 400).tolist())
    u = np.cumsum(rng.standard_normal(len(t_s)))
    instants = instants_of(t_s)
    out = instants.over(u, lambda even: law(even, instants.even_s))
    error = out - finely(t_s, u, law)
    assert float(np.abs(error).max()) < 0.01 * float(np.abs(u).max())
    by_rows = law(u, instants.step_s) - finely(t_s, u, law)
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(by_rows**2))


def test_behind_a_gap_it_begins_anew() -> None:
    """A row alone that is missing is none: its command is held for longer."""
    t_s = np.concatenate([1e-3 * np.arange(50), 0.3 + 1e-3 * np.arange(50)])
    lost = np.delete(np.arange(100), 20)
    u = np.repeat([1.0, 5.0], 50)
    instants = instants_of(t_s, (20, 50))
    assert instants.starts.tolist() == [50]
    out = instants.over(u, lambda even: delayed(even, instants.even_s, (5e-3,)))
    assert np.array_equal(out, u)
    assert instants.unknown.tolist() == list(range(50, 70)), "a fifth of the record at most"
    behind = np.concatenate([np.arange(9000), 10_000 + np.arange(1000)]) / 1024
    assert instants_of(behind).unknown.tolist() == list(range(9000, 9205)), "0.2 s"
    assert not len(instants_of(behind[:9000]).unknown), "what began a record is taken as it was"
    assert instants_of(t_s[lost], (20, 49)).starts.tolist() == [49]
    assert not len(instants_of(t_s[:0]).unknown), "nor is there any of an empty record"


def rho_of(model: Machine, chunk: FloatArray, late_s: float) -> float:
    """What a delay leaves, in times of the noise."""
    delay = next(timing for timing in TIMINGS if timing.effect == "input_delay")
    revision = Revision((), ((delay, (late_s,)),))
    return one_pass(model, chunk, prepare(model, chunk), revision, None, False, thorough=False).rho


def unevenly(model: Machine, chunk: FloatArray) -> FloatArray:
    """Seven of each twenty samples, the command the mean over their intervals."""
    whole = chunk[: len(chunk) // 20 * 20]
    at = np.flatnonzero(np.isin(np.arange(len(whole)) % 20, KEPT))
    rows = whole[at].copy()
    u = 2 + model.column("u")
    rows[:, u] = np.add.reduceat(whole[:, u], at) / np.diff(at, append=len(whole))
    return rows


def test_a_delay_is_found_where_the_steps_are_uneven() -> None:
    """By rows times the usual step 10 ms left 8.1 times the noise, and 11.5 ms 1.7."""
    model, chunk, _ = record("input_delay", 10e-3)
    rows = unevenly(model, chunk)
    assert rho_of(model, rows, 10e-3) < 1.1
    assert rho_of(model, rows, 11.5e-3) > 2.0


def test_a_long_delay_leaves_nothing_behind_gaps() -> None:
    """Nobody knows what was sent in a gap: what it still does behind it is no misfit."""
    model, chunk, _ = record("input_delay", 20e-3)
    since = chunk[:, 0] % 1.0
    rows = chunk[since >= 0.15].copy()
    behind = np.flatnonzero(np.diff(rows[:, 0], prepend=rows[0, 0]) > 0.1)
    rows[behind, 1] = rows[behind, 1].astype(int) | GAP_FLAG
    assert rho_of(model, rows, 20e-3) < 1.1
