"""The gates of samples and rows in the estimator, on a piston that a known map moves.

One chamber or two, one block per edge, 10 ms per sample.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_bridge.samples import GAP, ROW
from rtid.estimator.state import State, build
from rtid.kernels import layout
from rtid.model import COMMAND, POSITION, PRESSURE, Chamber, Edge, Gates, Grid, Machine, Signal
from rtid.plain import FloatArray

DT, AREA, V0, Q, SD = 0.01, 2e-3, 6e-4, 1e-4, 6.0
GRID = Grid(np.array([1.0, 4.0]), np.array([0.0, 10e6]))


def model(chambers: int = 1, recovery_s: float = 0.0) -> Machine:
    ends = (("pa", "p_s", "p_a", 1), ("bt", "p_b", "p_t", 1))[:chambers]
    both = (Chamber("a", "p_a", AREA, 1, V0), Chamber("b", "p_b", AREA, -1, V0))[:chambers]
    return Machine(
        signals=(
            Signal("u", COMMAND, "V", 0.0, 0.0, -5.0, 5.0),
            *(Signal(p, PRESSURE, "Pa", 1e3, 0.0, 0.0, 20e6) for p in ("p_a", "p_b", "p_s", "p_t")),
            Signal("x", POSITION, "m", 1e-5, 0.0, -1.0, 2.0),
        ),
        chambers=both,
        edges=tuple(Edge(n, a, b, "u", d, GRID, 1.0, Q, 5e6) for n, a, b, d in ends),
        position="x",
        beta_nominal_pa=1e9,
        beta_bounds_pa=(2e8, 2e9),
        gates=Gates(max_gap_s=0.025, recovery_s=recovery_s),
    )


def record(n: int, first: int = 0) -> FloatArray:
    """Rows [t, flags, u, p_a, p_b, p_s, p_t, x] of a motion at Q / AREA."""
    k = np.arange(first, first + n)
    rows = np.zeros((n, 8))
    rows[:, 0], rows[:, 1] = DT * k, ROW
    rows[:, 2:7] = 2.0, 5e6, 5e6, 10e6, 0.0
    rows[:, 7] = 0.1 + Q / AREA * DT * k
    return rows


def held(chambers: int = 1, rows: int = 3, sd: float = 0.0) -> State:
    """A state that has begun, and judges by the true map; sd: of its flow, shares of the rated."""
    state = build(model(chambers))
    state.advance(record(3))
    n = chambers
    theta = np.zeros((n, 6))
    theta[:, 0] = 1.0  # in units of the rated flow
    cells = np.arange(n)
    cov = np.zeros((n, 6, 6))
    cov[:, 0, 0] = sd**2
    state.hold(cells, theta, cov, np.ones(n), np.zeros(0))
    state.engine[0]["gate_sd"], state.engine[0]["gate_rows"] = SD, rows
    return state


def counted(state: State) -> dict[str, int]:
    return {name: n for name, n in state.counters.items() if n}


def surprised(state: State) -> tuple[float, int]:
    return float(state.blocks["surprise"].sum()), int(state.blocks["judged"].sum())


@pytest.mark.parametrize("chambers", [1, 2])
def test_a_motion_as_the_map_says_is_no_surprise(chambers: int) -> None:
    state = held(chambers)
    state.advance(record(20, 3))
    counts = counted(state)
    assert counts["samples"] == 23 and counts["rows"] == 22 and "outlier" not in counts
    surprise, judged = surprised(state)
    assert surprise < 1e-12 and judged >= 19 * chambers**2


@pytest.mark.parametrize("chambers", [1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_one_outlier_costs_one_row(chambers: int, sign: int) -> None:
    state, rows = held(chambers), record(20, 3)
    rows[10, 7] += sign * 5e-3
    state.advance(rows)
    counts = counted(state)
    assert counts["outlier"] == 1 and counts["rows"] == 21 and "reopened" not in counts
    surprise, _ = surprised(state)
    assert surprise == pytest.approx(SD**2 * (1 if chambers == 1 else 2) * chambers, rel=0.3)
    assert state.engine[0]["refused"] == 0


def test_a_small_error_is_followed_and_fades() -> None:
    """Within the limit the row counts, and what it leaves is judged until it has faded."""
    state, rows = held(), record(6, 3)
    rows[1:, 7] += 2e-5
    state.advance(rows[:2])
    first, _ = surprised(state)
    assert 0.5 < first < SD**2 and counted(state)["rows"] == 4
    gap = abs(float(state.engine[0]["gap"][0]))
    assert 0 < gap < AREA * 2e-5
    state.advance(rows[2:])
    assert abs(float(state.engine[0]["gap"][0])) < gap
    second, _ = surprised(state)
    assert first < second < 6 * first


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_what_lasts_opens_the_gate(n: int) -> None:
    """A step is refused `gate_rows` times; then all is admitted, and still judged."""
    state, rows = held(rows=n), record(12, 3)
    rows[2:, 7] += 5e-3
    state.advance(rows)
    counts, e = counted(state), state.engine[0]
    assert counts["outlier"] == n and counts["reopened"] == 1
    assert e["admits_all"] == 1 and e["refused"] == 0
    assert counts["restart_gap"] == 1  # all memory ended once
    again = rows[-1:].copy()
    again[0, 0] += DT
    again[0, 7] += 1e-2
    before = surprised(state)
    state.advance(again)
    assert counted(state)["outlier"] == n
    assert surprised(state)[0] - before[0] == pytest.approx(SD**2)


def test_refusals_are_counted_anew_after_a_good_row() -> None:
    state, rows = held(rows=2), record(12, 3)
    rows[2:9:2, 7] += 5e-3
    state.advance(rows)
    assert counted(state)["outlier"] == 4 and "reopened" not in counted(state)


@pytest.mark.parametrize("chambers", [1, 2])
def test_the_maps_own_error_widens_the_gate(chambers: int) -> None:
    """It adds up from row to row and fades as the gap does: soon it stays."""
    sure, unsure, rows = held(chambers), held(chambers, sd=0.5), record(40, 3)
    for state in (sure, unsure):  # flow noise as large as that of the position: it fades soon
        state.engine[0]["q_floor"][:] = (AREA * 1e-5) ** 2 / DT
    e, sds = unsure.engine[0], list[float]()
    for k in range(40):
        unsure.advance(rows[k : k + 1])
        sds.append(float(e["gap_sd"][chambers - 1]))
    assert 0 < 1.2 * sds[0] < sds[20] and sds[39] == pytest.approx(sds[20], rel=0.05)
    sure.advance(rows)
    more = record(1, 43)
    more[0, 7] += 2e-5
    seen = [surprised(state)[0] for state in (sure, unsure)]
    for state in (sure, unsure):
        state.advance(more)
    told, less = (surprised(s)[0] - b for s, b in zip((sure, unsure), seen, strict=True))
    assert 0 < less < told


def test_windows_that_share_a_point_answer_once() -> None:
    """Of up to four windows the one of the cell that holds the point is judged."""
    fine = Grid(np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.0, 4.9e6, 9e6, 10e6]))
    plain = model()
    edges = tuple(replace(e, grid=fine, basis="blended") for e in plain.edges)
    state = build(replace(plain, edges=edges))
    state.advance(record(3))
    e, n = state.engine[0], len(state.cells)
    theta = np.zeros((n, 6))
    theta[:, 0] = 1.0
    slots = int(e["n_slots"])
    assert slots > 1 and e["n_open"] > 1, "the point lies in one window alone"
    used = np.flatnonzero(state.cells["slot"] >= 0)
    state.hold(used, theta[used], np.zeros((slots, 6, 6)), np.ones(1), np.zeros(0))
    e["gate_sd"], e["gate_rows"] = 1e6, 100
    state.advance(record(10, 3))
    judged = state.blocks["judged"][:slots]
    assert sorted(judged)[-1] == judged.sum() == 10
    i, j = e["home"][0]
    assert state.blocks["cell"][int(np.argmax(judged))] == i * 3 + j


def test_without_a_limit_nothing_is_judged() -> None:
    state, rows = held(), record(6, 3)
    state.engine[0]["gate_sd"] = 0.0
    rows[3, 7] += 1.0
    state.advance(rows)
    assert "outlier" not in counted(state) and surprised(state) == (0.0, 0)


def test_an_unknown_block_is_not_judged() -> None:
    """Its flow is no error of the map: the gap begins at zero behind it."""
    state, rows = held(), record(8, 3)
    state.cells["known"][:] = 0
    rows[:, 7] = rows[0, 7]
    state.advance(rows)
    assert "outlier" not in counted(state) and surprised(state) == (0.0, 0)
    assert counted(state)["rows"] == 2 + 8 and state.engine[0]["gap"][0] == 0.0
    state.cells["known"][:] = 1
    more = record(3, 11)
    more[:, 7] = rows[0, 7] + Q / AREA * DT * np.arange(1, 4)
    state.advance(more)
    assert "outlier" not in counted(state)


@pytest.mark.parametrize(("column", "value", "reason"), [
    (0, np.nan, "not_finite"), (2, np.nan, "not_finite"), (3, np.inf, "not_finite"),
    (7, -np.inf, "not_finite"), (7, 1e30, "not_finite"), (7, 0.9e30, "out_of_range"),
    (2, -5.000001, "out_of_range"), (2, 5.000001, "out_of_range"), (3, -1e-3, "out_of_range"),
    (6, 20.000001e6, "out_of_range"), (7, 2.000001, "out_of_range"),
])  # fmt: skip
def test_an_unfit_sample_is_refused_under_its_reason(
    column: int, value: float, reason: str
) -> None:
    state, rows = build(model()), record(8)
    rows[4, column] = value
    state.advance(rows)
    counts = counted(state)
    assert counts[reason] == 1 and len({"not_finite", "out_of_range"} & set(counts)) == 1
    assert counts["samples"] == 8 and counts["rows"] == 5  # 3 before, 2 behind a new start


@pytest.mark.parametrize(("column", "value"), [(2, -5.0), (2, 5.0), (3, 0.0), (6, 20e6)])
def test_the_ends_of_a_range_belong_to_it(column: int, value: float) -> None:
    state, rows = build(model()), record(4)
    rows[3, column] = value
    state.advance(rows)
    assert not {"not_finite", "out_of_range"} & set(counted(state))


@pytest.mark.parametrize(("dt", "rows_made"), [
    (0.025, 5), (0.0250004, 5), (0.025001, 4), (0.03, 4), (0.0, 4), (-0.01, 4), (0.001, 5),
])  # fmt: skip
def test_a_gap_ends_the_memory(dt: float, rows_made: int) -> None:
    """Longer than declared, or not forward; steps count in whole microseconds."""
    state, rows = build(model()), record(6)
    rows[3:, 0] += dt - DT
    state.advance(rows)
    counts = counted(state)
    assert counts["rows"] == rows_made
    assert counts.get("restart_gap", 0) == 5 - rows_made


def test_a_flagged_gap_is_one() -> None:
    state, rows = build(model()), record(6)
    rows[3, 1] = ROW | GAP
    state.advance(rows)
    assert counted(state)["restart_gap"] == 1 and counted(state)["rows"] == 4


def test_the_first_sample_ends_nothing() -> None:
    state, rows = build(model()), record(3)
    rows[0, 1] = ROW | GAP
    state.advance(rows)
    assert "restart_gap" not in counted(state) and counted(state)["rows"] == 2


def test_rows_come_where_the_position_was_measured() -> None:
    state, rows = build(model()), record(9)
    rows[[0, 2, 3, 6], 1] = 0
    state.advance(rows)
    assert counted(state)["rows"] == 4 and state.engine[0]["t_s"] == rows[-1, 0]


@pytest.mark.parametrize(("fault", "begins"), [("gap", 3), ("value", 3), ("time", 3)])
def test_after_a_fault_it_waits_to_recover(fault: str, begins: int) -> None:
    """0.03 s without a start, counted from the fault; those samples are told."""
    state, rows = build(model(recovery_s=0.03)), record(14)
    if fault == "gap":
        rows[begins:, 0] += 0.1
    elif fault == "value":
        rows[begins, 3] = -1.0
    else:
        rows[begins, 0] = np.nan
    state.advance(rows)
    counts = counted(state)
    waited = counts["recovering"]
    assert waited == {"gap": 3, "value": 2, "time": 1}[fault]
    assert counts["rows"] == {"gap": 2 + 7, "value": 2 + 7, "time": 2 + 8}[fault]


def test_off_the_grid_memory_ends_and_begins_again() -> None:
    state, rows = build(model()), record(9)
    rows[4:6, 2] = 4.5
    state.advance(rows)
    counts = counted(state)
    assert counts["outside_grid"] >= 1 and counts["rows"] < 8
    assert set(counts) <= set(layout.COUNTERS)
