"""Motion that was held out is judged where it is like what taught the maps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.diagnose import diagnosis
from rtid.diagnose.visited import PARTS, where_taught
from rtid.model import Grid
from rtid.plain import FloatArray

GRID = Grid(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1e6, 4e6]))
LEAST = 20


def passed(
    w: FloatArray, drop_pa: FloatArray, taught: Any = None, *, pressures: bool = True
) -> Any:
    """A record of one edge at openings w and drops (n - 1,), V and Pa."""
    edge = SimpleNamespace(source="p", sink="t", grid=GRID, safe_band_v=0.1)
    signals = {"p": np.append(drop_pa, drop_pa[-1]), "t": np.zeros(len(w) + 1)}
    gates = SimpleNamespace(min_rows=LEAST)
    return SimpleNamespace(
        model=SimpleNamespace(edges=(edge,), gates=gates, has_pressures=pressures),
        n=len(w) + 1, opening=lambda _: w, signal=signals.get, taught=taught,
        inside=np.ones(len(w), bool),
    )  # fmt: skip


def many(w: float, drop_pa: float, n: int) -> Any:
    return passed(np.full(n, w), np.full(n, drop_pa))


@pytest.mark.parametrize(("n", "is_known"), [(LEAST, True), (LEAST - 1, False)])
def test_a_part_of_a_block_is_known_that_has_taught_enough(n: int, is_known: bool) -> None:
    here = passed(np.array([0.6]), np.array([1.5e6]), many(0.7, 1.6e6, n))
    assert where_taught(here).tolist() == [is_known]


@pytest.mark.parametrize(
    ("w", "drop_pa", "is_known"),
    [(0.3, 1.5e6, False), (0.6, 1.5e6, True), (0.6, 3.5e6, False), (0.9, 1.5e6, False)],
)
def test_what_is_beside_it_in_the_same_block_is_not(
    w: float, drop_pa: float, is_known: bool
) -> None:
    """A valve that opens at 0.5 and was seen above alone: what is below it nobody knows."""
    here = passed(np.array([w]), np.array([drop_pa]), many(0.6, 1.5e6, 500))
    assert where_taught(here).tolist() == [is_known]
    assert PARTS == 4, "parts of 0.25 V, and of 0.75 MPa in the second block"


def test_a_valve_that_is_shut_needs_no_visits() -> None:
    taught = many(0.6, 1.5e6, 500)
    assert where_taught(passed(np.array([0.05]), np.array([3.5e6]), taught)).all()


def test_of_the_record_itself_and_of_a_rate_all_is_known() -> None:
    assert where_taught(many(0.6, 1.5e6, 3)).all()
    taught = many(0.6, 1.5e6, 1)
    assert where_taught(passed(np.ones(2), np.ones(2), taught, pressures=False)).all()


@pytest.mark.parametrize("is_enough", [True, False])
def test_where_too_little_is_like_what_taught_all_of_it_judges(
    monkeypatch: pytest.MonkeyPatch, is_enough: bool
) -> None:
    monkeypatch.setattr(diagnosis, "can_judge", lambda _: is_enough)
    state: Any = SimpleNamespace(as_taught=False)
    state.left = lambda fit: (fit, state.as_taught)
    first: Any = "first"
    last: Any = "last"
    judged: Any = diagnosis._as_taught(state, first, last)
    assert judged == ((("first", True), ("last", True)) if is_enough else None)
    assert state.as_taught is is_enough
