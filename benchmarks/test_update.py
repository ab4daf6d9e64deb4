"""Update per sample: rtid beside the same work in C by hand, and beside other libraries."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from time import perf_counter, sleep
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks import rls
from benchmarks.compiler import compile_c
from benchmarks.interleave import Job, ratio, report, side_by_side
from benchmarks.machine import chunk, empty, model, one_block, one_chamber, record, warmed
from benchmarks.reference import Reference
from rtid.estimator.state import State
from rtid.estimator.sums import Sums
from rtid.kernels.engine import advance
from rtid.model import Machine

FloatArray = NDArray[np.float64]

C_BY_HAND, ARRAYS = "hand-written C", "rtid, over arrays"
PER_SAMPLE, KERNEL = "rtid, State.advance per sample", "rtid, kernel called per sample"
ALL = len(record())
FEW = 2000  # samples for the slow ones
BLOCK = 3000  # samples of the calls one by one
# wide gates, for computers of all kinds: a factor that is lost is seen
LOST, AHEAD = 2.2, 40.0
ASKED = {ARRAYS: "1.3 x", PER_SAMPLE: "0.45 us", KERNEL: "0.35 us"}
ASKED_STANDING = {1: {ARRAYS: "1.6 x"}, 2: {ARRAYS: "1.85 x"}}  # by the number of chambers


def normal_equations(state: State) -> tuple[FloatArray, FloatArray]:
    """Gram matrix scaled to a unit diagonal, and right-hand side in the same scale."""
    normal = Sums.of(state).normal()
    scale = np.sqrt(np.where(np.diag(normal.gram) > 0, np.diag(normal.gram), 1.0))
    return normal.gram / np.outer(scale, scale), normal.right / scale / np.sqrt(normal.square)


@pytest.mark.parametrize("chambers", [1, 2])
def test_c_by_hand_gives_the_same_sums(chambers: int) -> None:
    machine = model() if chambers == 2 else one_chamber(model())
    ours, theirs, reference, data = empty(machine), empty(machine), Reference(), chunk(record())
    ours.advance(data)
    reference.advance(theirs, data)
    assert ours.engine[0]["counters"].tolist() == theirs.engine[0]["counters"].tolist()
    for a, b in zip(normal_equations(ours), normal_equations(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)


def test_the_other_libraries_find_the_same_parameters() -> None:
    data = rls.samples(FEW)
    expected = rls.by_numpy(data)
    library = compile_c("rls")
    for values in (rls.by_c(library, data), rls.by_filterpy(data), rls.by_padasip(data)):
        np.testing.assert_allclose(values, expected, atol=1e-6)


def standing() -> FloatArray:
    """One sample of the record held for BLOCK samples: no change of block hides what a row costs.

    The swept sine changes blocks 20 times in 1,000 samples.
    """
    data = chunk(record())
    held = np.repeat(data[ALL // 3 : ALL // 3 + 1], BLOCK, axis=0)
    held[:, 0] = data[-1, 0] + 1e-3 * np.arange(1, BLOCK + 1)
    return held


def standing_jobs(machine: Machine) -> list[Job]:
    """The joint update by C and by rtid over arrays, without changes of block."""
    data, held, reference = chunk(record()), standing(), Reference()
    by_c, by_arrays = (warmed(machine, data) for _ in range(2))
    return [
        Job(C_BY_HAND, lambda: reference.advance(by_c, held), BLOCK),
        Job(ARRAYS, lambda: by_arrays.advance(held), BLOCK),
    ]


def joint_jobs(machine: Machine) -> list[Job]:
    """The joint update by C, by rtid over arrays and by rtid one sample at a time.

    A call of the kernel on prepared memory is the least that Python can do.
    """
    data, reference = chunk(record()), Reference()
    by_c, by_arrays, by_calls, by_kernel = (warmed(machine, data) for _ in range(4))
    rows = [data[k : k + 1] for k in range(BLOCK)]
    return [
        Job(C_BY_HAND, lambda: reference.advance(by_c, data), ALL),
        Job(ARRAYS, lambda: by_arrays.advance(data), ALL),
        Job(PER_SAMPLE, lambda: one_by_one(by_calls.advance, rows), BLOCK),
        Job(KERNEL, lambda: one_by_one(partial(advance, by_kernel.memory), rows), BLOCK),
    ]


def one_by_one(take: Callable[[FloatArray], object], rows: list[FloatArray]) -> None:
    """Call take once per sample."""
    for row in rows:
        take(row)


def test_update_of_one_chamber(benchmark: Any) -> None:
    title = "Update, one chamber, two edges, one shared parameter, 30 x 20 blocks per edge"
    jobs = joint_jobs(one_chamber(model()))
    times = side_by_side(benchmark, title, "sample", jobs, C_BY_HAND, asked=ASKED)
    assert ratio(times, ARRAYS, C_BY_HAND) <= LOST


def test_update_of_one_block(benchmark: Any) -> None:
    """The others filter, evaluate the basis and update; rtid also gates and looks for the block."""
    ours, theirs, library = chunk(record()), rls.samples(ALL), compile_c("rls")
    few, rows = theirs[:FEW], [ours[k : k + 1] for k in range(BLOCK)]
    state = warmed(one_block(model()), ours)
    jobs = [
        Job(ARRAYS, lambda: state.advance(ours), ALL),
        Job(PER_SAMPLE, lambda: one_by_one(state.advance, rows), BLOCK),
        Job("C by hand, covariance form", lambda: rls.by_c(library, theirs), ALL),
        Job("numpy", lambda: rls.by_numpy(few), FEW),
        Job("padasip", lambda: rls.by_padasip(few), FEW),
        Job("filterpy", lambda: rls.by_filterpy(few), FEW),
    ]
    title = "The same job, one chamber, one block, 7 parameters: filter, basis, update"
    asked = {PER_SAMPLE: ASKED[PER_SAMPLE], "padasip": "100 x", "filterpy": "100 x"}
    times = side_by_side(benchmark, title, "sample", jobs, ARRAYS, asked=asked)
    assert min(ratio(times, name, ARRAYS) for name in ("padasip", "filterpy")) >= AHEAD


def test_update_of_two_chambers(benchmark: Any) -> None:
    title = "Update, two chambers whitened jointly, four edges, 30 x 20 blocks per edge"
    jobs = joint_jobs(model())
    times = side_by_side(benchmark, title, "sample", jobs, C_BY_HAND, asked={ARRAYS: "1.3 x"})
    assert ratio(times, ARRAYS, C_BY_HAND) <= LOST


@pytest.mark.parametrize("chambers", [1, 2])
def test_update_without_changes_of_block(benchmark: Any, chambers: int) -> None:
    machine = model() if chambers == 2 else one_chamber(model())
    title = f"Update without changes of block, chambers: {chambers}"
    jobs, asked = standing_jobs(machine), ASKED_STANDING[chambers]
    times = side_by_side(benchmark, title, "sample", jobs, C_BY_HAND, rounds=60, asked=asked)
    assert ratio(times, ARRAYS, C_BY_HAND) <= LOST


def test_update_cold_inside_a_1_khz_loop(benchmark: Any) -> None:
    """Each call finds the caches as 1 ms of sleep left them."""
    data = chunk(record())
    state = warmed(one_chamber(model()), data)

    def loop() -> list[float]:
        times = []
        for k in range(2000):
            sleep(1e-3)
            start = perf_counter()
            state.advance(data[k : k + 1])
            times.append(perf_counter() - start)
        return times

    times = benchmark.pedantic(loop, rounds=1)
    rows = [
        {"name": name, "seconds": float(np.percentile(times, share))}
        for name, share in (("p50", 50), ("p99", 99), ("p99.9", 99.9))
    ]
    report(benchmark, "Update, one chamber, once per ms in a sleeping loop (cold)", "sample", rows)
