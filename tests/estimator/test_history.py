"""The ring buffer beside a plain list: order, wrap-around, gaps, chunks of any size, saving."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtid.estimator.ring import History, HistoryError
from rtid.plain import FloatArray

SIGNALS = 3

sizes = st.lists(st.integers(0, 70), max_size=30)


def rows(n: int, start: int = 0, gap_s: float = 0.0) -> FloatArray:
    """n rows at 128 Hz, exact in binary, that are all different."""
    count = np.arange(start, start + n)[:, None]
    out = count + np.arange(2 + SIGNALS) / 10
    out[:, 0] = count[:, 0] / 128 + gap_s
    return np.asarray(out, np.float64)


@given(sizes, st.integers(1, 40), st.floats(0, 5))
def test_equals_a_plain_list(chunks: list[int], capacity: int, gap_s: float) -> None:
    """Chunks of 0, 1 and more than the capacity, with gaps between them."""
    ring = History(SIGNALS, span_s=0.25, rows_per_s=capacity / 0.25)
    plain: list[FloatArray] = []
    for k, n in enumerate(chunks):
        chunk = rows(n, len(plain), k * gap_s)
        ring.append(chunk)
        plain.extend(chunk)
        kept = [row for row in plain[-capacity:] if row[0] >= plain[-1][0] - 0.25]
        np.testing.assert_array_equal(ring.chunk(), np.reshape(kept, (-1, 2 + SIGNALS)))
        assert len(ring) == min(len(plain), capacity) <= ring.capacity == capacity
        assert (ring.seen, ring.overwritten) == (len(plain), max(0, len(plain) - capacity))


@given(sizes, st.integers(0, 9))
def test_saved_and_read_back_it_goes_on_the_same(chunks: list[int], last: int) -> None:
    ring = History(SIGNALS, span_s=0.4, rows_per_s=100)
    total = 0
    for n in chunks:
        ring.append(rows(n, total))
        total += n
    twin = History.from_arrays(ring.to_arrays())
    for other in (ring, twin):
        other.append(rows(last, total))
    np.testing.assert_array_equal(twin.chunk(), ring.chunk())
    assert (twin.seen, twin.capacity, twin.span_s) == (ring.seen, ring.capacity, ring.span_s)


def test_time_trims_before_memory_does() -> None:
    ring = History(SIGNALS, span_s=10.0, rows_per_s=1000)
    ring.append(rows(2560))  # 20 s at an eighth of the declared rate
    assert len(ring.chunk()) == 1281
    assert len(ring.chunk(2.0)) == 257
    assert len(ring) == 2560


def test_rows_that_come_too_fast_shorten_the_span_visibly() -> None:
    ring = History(SIGNALS, span_s=10.0, rows_per_s=64)
    ring.append(rows(2560))
    assert ring.held_s == 639 / 128
    assert ring.overwritten == 1920


def test_rows_before_a_step_back_of_the_clock_stay() -> None:
    ring = History(SIGNALS, span_s=1.0, rows_per_s=1000)
    first, second = rows(50, 1000), rows(50, 0)
    ring.append(first)
    ring.append(second)
    np.testing.assert_array_equal(ring.chunk(), np.concatenate([first, second]))


def test_memory_is_fixed_and_the_copy_is_its_own() -> None:
    ring = History(SIGNALS, span_s=1.0, rows_per_s=100)
    memory = ring._rows
    ring.append(rows(250))
    ring.chunk()[:] = -1.0
    np.testing.assert_array_equal(ring.chunk(), rows(100, 150))
    assert ring._rows is memory


def test_clear_forgets_all() -> None:
    ring = History(SIGNALS)
    ring.append(rows(10))
    ring.clear()
    assert ring.chunk().shape == (0, 2 + SIGNALS)
    assert ring.capacity == 120_000


@pytest.mark.parametrize("shape", [(4, 2), (5,), (1, 6)])
def test_other_rows_are_refused(shape: tuple[int, ...]) -> None:
    ring = History(SIGNALS)
    with pytest.raises(HistoryError, match="does not fit"):
        ring.append(np.zeros(shape))
    assert ring.seen == 0


def test_arrays_of_something_else_are_refused() -> None:
    good = History(SIGNALS, 1.0, 10).to_arrays()
    for name in good:
        with pytest.raises(HistoryError, match="no saved history"):
            History.from_arrays({k: v for k, v in good.items() if k != name})
    with pytest.raises(HistoryError, match="no saved history"):
        History.from_arrays({**good, "rows": np.zeros((3, 5))})
