"""What the update costs as the grid and the shared part grow."""

from __future__ import annotations

from typing import Any

from benchmarks.interleave import Job, side_by_side
from benchmarks.machine import chunk, model, one_chamber, record, warmed
from rtid.kernels.layout import BLOCK_CHANGES, SAMPLES
from rtid.model import Machine

GRIDS = ((10, 8), (30, 20), (100, 80))


def arrays_job(label: str, machine: Machine, shared: int | None = None) -> Job:
    """The update over arrays; the name tells how often the working point changed the block."""
    data = chunk(record())
    state = warmed(machine, data, shared)
    counters = state.engine[0]["counters"]
    share = 100.0 * counters[BLOCK_CHANGES] / counters[SAMPLES]
    name = f"{label} ({state.engine[0]['n_slots']} visited, {share:.1f} % of samples change block)"
    return Job(name, lambda: state.advance(data), len(data))


def alike(jobs: list[Job]) -> dict[str, str]:
    """What is asked of the larger grids: the cost per sample of the smallest."""
    return {job.name: "0.8 to 1.2 x" for job in jobs[1:]}


def test_finer_grids(benchmark: Any) -> None:
    jobs = [arrays_job(f"{a} x {b} blocks per edge", model((a, b))) for a, b in GRIDS]
    title = "Growth, finer grids over the same range, two chambers"
    side_by_side(benchmark, title, "sample", jobs, jobs[0].name, asked=alike(jobs))


def test_larger_grids(benchmark: Any) -> None:
    jobs = [arrays_job(f"{a} x {b} blocks per edge", model((a, b), span=True)) for a, b in GRIDS]
    title = "Growth, more blocks of the same size, two chambers"
    side_by_side(benchmark, title, "sample", jobs, jobs[0].name, asked=alike(jobs))


def test_shared_columns(benchmark: Any) -> None:
    machine = one_chamber(model((10, 8)))
    jobs = [arrays_job(f"{n} shared columns", machine, n) for n in (1, 5, 20)]
    title = "Growth, shared columns (their own evaluation not included), one chamber, 10 x 8 blocks"
    side_by_side(benchmark, title, "sample", jobs, jobs[0].name)
