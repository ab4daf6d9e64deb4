"""The innovation gate through the Estimator: what it refuses, what that costs, when it opens again.

The plant is one chamber whose maps are bilinear, so that six terms per block are exact: what the
gate refuses there is not the blocks' own misfit.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from firmware_bridge.samples import GAP as GAP_FLAG
from firmware_bridge.samples import ROW as ROW_FLAG
from rtid.estimator.blocks import VALID, Block
from rtid.estimator.chunk import to_chunk
from rtid.estimator.estimator import Estimator
from rtid.model import (
    COMMAND,
    POSITION,
    PRESSURE,
    Chamber,
    Edge,
    Gates,
    Grid,
    Machine,
    Signal,
    Upkeep,
)
from rtid.plain import FloatArray
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate

U_V, DP_PA = np.array([1.0, 3.0, 5.0, 10.0]), np.array([0.0, 2.0, 4.0, 6.0, 9.0]) * 1e6
RATED_M3S, AREA_M2, V0_M3, COMPLIANCE = 1e-4, 2e-3, 6e-4, 1 / 1.05e9
P_A, X = 3, 6  # columns of a chunk: [t, flags, u, p_a, p_s, p_t, x]
UPKEEP = Upkeep(every_s=2.0, forget_s=60.0, shared_forget_s=600.0, innovation_sd=8.0)
OPEN = replace(UPKEEP, innovation_sd=0.0)
LEARNED, RATE = 30_000, 1000  # samples before the gate is used, samples per second


def exact_model(upkeep: Upkeep, gates: Gates | None = None) -> Machine:
    """Two edges in and out of one chamber on a grid of 3 x 4 blocks each."""
    ends = (("pa", "p_s", "p_a", 1), ("at", "p_a", "p_t", -1))
    grid = Grid(U_V, DP_PA)
    return Machine(
        signals=(
            Signal("u", COMMAND),
            *(Signal(p, PRESSURE, "Pa", 5e3, 0.0, -1e6, 1e8) for p in ("p_a", "p_s", "p_t")),
            Signal("x", POSITION, "m", 1e-5, 0.0, -1.0, 2.0),
        ),
        chambers=(Chamber("a", "p_a", AREA_M2, 1, V0_M3),),
        edges=tuple(
            Edge(name, source, sink, "u", way, grid, 1.0, RATED_M3S, 5e5)
            for name, source, sink, way in ends
        ),
        position="x",
        beta_nominal_pa=1e9,
        beta_bounds_pa=(2e8, 1.6e9),
        gates=gates or Gates(),
        upkeep=upkeep,
    )


def flow(w: Any, dp: Any) -> Any:
    """The true map of both edges, m3/s."""
    return RATED_M3S * (w - 1.0) / 4.0 * (0.4 + dp / 5e6)


@cache
def exact_record(n: int, step_at: int = 10**9, gain: float = 1.0) -> FloatArray:
    """Chunk (n, 7) at 1 kHz with sensor noise; from sample step_at on all flows times gain."""
    rng, t = np.random.default_rng(0), np.arange(n) * 1e-3

    def wave(size: float, low: float, high: float) -> FloatArray:
        rates, phases = rng.uniform(low, high, 5), rng.uniform(0, 2 * np.pi, 5)
        return np.asarray(size * np.sin(2 * np.pi * np.outer(t, rates) + phases).sum(1) / 5**0.5)

    p_a = 4e6 + np.clip(wave(2.2e6, 0.3, 4), -3.5e6, 3.5e6)
    p_s, p_t, wanted = 8.2e6 + wave(1e5, 0.1, 0.5), np.full(n, 1e5), wave(6.0, 0.3, 2.0)
    u, x = np.zeros(n), np.full(n, 0.25)
    inflow, outflow = 0.5 * (p_s[1:] + p_s[:-1] - p_a[1:] - p_a[:-1]), 0.5 * (p_a[1:] + p_a[:-1])
    for k in range(n - 1):  # A dx = Q dt - (V0 + A (x + dx / 2)) dP / beta
        u[k] = u[k - 1] if k % 10 else np.clip(wanted[k] + 20 * (0.25 - x[k]), -9.5, 9.5)
        q = flow(u[k], inflow[k]) if u[k] > 1 else 0.0
        q -= flow(-u[k], outflow[k] - 1e5) if u[k] < -1 else 0.0
        squeezed = (p_a[k + 1] - p_a[k]) * COMPLIANCE
        moved = q * 1e-3 * (gain if k >= step_at else 1.0) - (V0_M3 + AREA_M2 * x[k]) * squeezed
        x[k + 1] = x[k] + moved / (AREA_M2 * (1 + 0.5 * squeezed))
    values = np.column_stack([u, p_a, p_s, p_t, x])
    values[:, 1:4] += 5e3 * rng.standard_normal((n, 3))
    values[:, 4] += 1e-5 * rng.standard_normal(n)
    return np.column_stack([t, np.ones(n), values])


def errors(est: Estimator, gain: float = 1.0, since_s: float = 0.0) -> FloatArray:
    """Error of the mean flow of each valid block visited since, as a share of the largest flow."""
    blocks = [b for b in est.solution().blocks if b.status == VALID and b.last_s >= since_s]
    return np.array([(b.mean_flow_m3s - gain * true_mean(b)) / (3 * RATED_M3S) for b in blocks])


def true_mean(block: Block) -> float:
    """True flow averaged over the data of a block, which is bilinear."""
    u, dp, mean = U_V[block.i : block.i + 2], DP_PA[block.j : block.j + 2], block.mean_phi
    w, gain_w = u.mean() - 1.0, 0.5 * np.diff(u)[0]
    a, gain_a = 0.4 + dp.mean() / 5e6, 0.5 * np.diff(dp)[0] / 5e6
    terms = np.array([w * a, gain_w * a, w * gain_a, 0.0, 0.0, gain_w * gain_a])
    return float(RATED_M3S / 4 * mean @ terms)


@cache
def _warm() -> Estimator:
    est = Estimator(exact_model(OPEN))
    est.advance(exact_record(90_000)[:LEARNED])
    return est


def gated() -> Estimator:
    """An estimator that has learned for 30 s without the gate, and now uses it."""
    est = _warm().copy()
    est.model = exact_model(UPKEEP)
    return est


def refused(chunk: FloatArray) -> tuple[Estimator, int, int]:
    """Take the rest of a record; (estimator, rows refused as outliers, times re-opened)."""
    est = gated()
    est.advance(chunk[LEARNED:])
    return est, est.counters["outlier"], est.counters["reopened"]


@cache
def last_before_changes(n: int) -> list[int]:
    """Samples after which the block changes, in the first n samples behind the learned ones."""
    est, found = gated(), []
    for k in range(LEARNED, LEARNED + n):
        before = est.counters["block_changes"]
        est.advance(exact_record(90_000)[k : k + 1])
        if est.counters["block_changes"] > before:
            found.append(k - 1)
    return found


@pytest.mark.first_of(1)
@pytest.mark.parametrize(("column", "size"), [(X, 1e-3), (P_A, 5e5), (P_A, 1.5e6)])
def test_single_outliers_are_refused_and_cost_little(column: int, size: float) -> None:
    clean = exact_record(90_000)
    changes = np.array(last_before_changes(40_000))
    rng, dirty = np.random.default_rng(1), clean.copy()
    at = 32_500 + 1000 * np.arange(40) + rng.integers(0, 500, 40)
    at = at[[not (np.abs(changes - k) <= 2).any() for k in at]]
    dirty[at, column] += size * rng.choice([-1.0, 1.0], len(at))
    plain, rows, _ = refused(clean)
    est, more_rows, _ = refused(dirty)
    cost = (more_rows - rows) / len(at)
    drift = np.abs(errors(est)).max()
    print(f"{len(at)} outliers: {cost:.2f} rows each, drift {drift:.1e}, rows refused clean {rows}")
    assert 0.9 <= cost <= 3.0
    assert drift < 1e-3
    assert est.counters["samples"] == plain.counters["samples"]


def test_an_outlier_just_before_a_change_of_block_costs_little() -> None:
    clean, costs = exact_record(90_000)[: LEARNED + 6000], []
    _, rows, times = refused(clean)
    for k in last_before_changes(5000)[30::6]:
        dirty = clean.copy()
        dirty[k, X] += 1e-3
        _, more_rows, more_times = refused(dirty)
        costs.append((more_rows - rows, more_times - times))
    print("rows refused and gates re-opened per outlier:", costs)
    assert max(c[0] for c in costs) <= 3
    assert max(c[1] for c in costs) == 0


def after_a_jump(announced: bool) -> tuple[Estimator, float]:
    """An estimator that saw its position's zero jump by 5 mm, and its error 9.5 s later."""
    jumped = exact_record(90_000)[: LEARNED + 20_000].copy()
    jumped[LEARNED + 10_000 :, X] += 5e-3
    if announced:
        jumped[LEARNED + 10_000, 1] = ROW_FLAG + GAP_FLAG
    est = gated()
    est.advance(jumped[LEARNED:-500])
    drift = float(np.abs(errors(est)).max())
    before = est.counters["rows"]
    est.advance(jumped[-500:])
    assert est.counters["rows"] - before > 450
    return est, drift


def test_a_sensor_whose_zero_jumps_is_as_if_the_jump_had_been_announced() -> None:
    est, drift = after_a_jump(announced=False)
    _, told = after_a_jump(announced=True)
    print(f"5 mm: drift {drift:.1e}, announced {told:.1e}, {est.counters['reopened']} re-opened")
    assert est.counters["reopened"] >= 1
    assert drift < 1.05 * told


@pytest.mark.xfail(
    strict=True,
    reason="1.3e-3, and 1.3e-3 where the jump is announced: 5 mm make V(x) wrong by 1.6 %",
)
def test_a_sensor_whose_zero_jumps_does_not_spoil_the_map() -> None:
    assert after_a_jump(announced=False)[1] < 1e-3


@pytest.mark.parametrize("plant", ["exact", "simulated"])
def test_clean_rows_are_not_refused(plant: str) -> None:
    if plant == "exact":
        est = Estimator(exact_model(UPKEEP))
        est.advance(exact_record(90_000)[:40_000])
    else:
        machine = draw(3)
        model = replace(declared_model(machine), upkeep=replace(UPKEEP, every_s=5.0))
        est = Estimator(model)
        est.advance(to_chunk(model, simulate(machine, "rich", 3, 14.0).samples, 0))
    share = est.counters["outlier"] / est.counters["rows"]
    print(f"{plant}: {share:.1e} of clean rows refused, {est.counters['reopened']} re-opened")
    assert share < 1e-4


def stepped(upkeep: Upkeep) -> Estimator:
    """Learned for 30 s; then the flows rise by 5 %, and 50 s pass."""
    record = exact_record(80_000, LEARNED, 1.05)
    est = Estimator(exact_model(replace(upkeep, innovation_sd=0.0)))
    est.advance(record[:LEARNED])
    est.model = exact_model(upkeep)
    est.advance(record[LEARNED:])
    return est


def again_wrong(blocks: list[Block]) -> list[float]:
    """Errors of mean flows after a step of 5 %, each as a share of its own flow."""
    return [abs(b.mean_flow_m3s / (1.05 * true_mean(b)) - 1) for b in blocks]


def test_a_step_of_the_gain_is_learned_again_where_it_is_visited() -> None:
    est = stepped(UPKEEP)
    blocks = [b for b in est.solution().blocks if b.last_s > LEARNED / RATE]
    often = [b for b in blocks if b.rows > 1000]
    error = again_wrong(often)
    print(f"{len(often)} of {len(blocks)} blocks, error {max(error):.1e} after a step of 5e-2")
    assert est.counters["reopened"] >= 1
    assert len(often) > 12
    assert max(error) < 5e-3
    assert all(b.status == VALID for b in often)


def test_a_step_is_learned_again_without_forgetting_by_time() -> None:
    est = stepped(replace(UPKEEP, forget_s=np.inf, shared_forget_s=np.inf))
    often = [b for b in est.solution().blocks if b.rows > 1000]
    assert max(again_wrong(often)) < 5e-3
    assert all(b.status == VALID for b in often)
