"""A fleet at size: efficiency of two workers, memory, cost per trace, killed and resumed.

RTID_FLEET: traces (100 by default; the issue asks for 2,000, an hour on two cores).
"""

from __future__ import annotations

import os
import resource
import time
from pathlib import Path

import numpy as np
import pytest

from rtid.fleet.archive import Archive
from rtid.fleet.learning import Outcome
from rtid.fleet.running import run
from rtid.fleet.traces import TraceJob, find
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.campaign.report import leave

TRACES = int(os.environ.get("RTID_FLEET", "100"))
BROKEN = 20  # of 2,000
RECORDS = 20  # that are simulated; the traces are theirs, each with another command level

pytestmark = pytest.mark.campaign


@pytest.fixture(scope="module")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> list[TraceJob]:
    """Traces of 20 s at 1 kHz, ten to a machine, one in a hundred of them broken."""
    folder = tmp_path_factory.mktemp("fleet")
    for k in range(TRACES):
        place = folder / "traces" / f"m{k // 10:03d}"
        place.mkdir(parents=True, exist_ok=True)
        path = place / f"{k:04d}.parquet"
        if k < RECORDS:
            write_run(path, simulate(SimulatedPlant(), "rich", k, 20.0), k, "rich")
            path.with_suffix(".truth.json").unlink()
            path.with_suffix(".toml").rename(folder / "project.toml")
        else:
            whole = folder / "traces" / f"m{k % RECORDS // 10:03d}" / f"{k % RECORDS:04d}.parquet"
            path.write_bytes(_other(whole, k))
        if k % 100 == 99:
            path.write_bytes(path.read_bytes()[: 1000 * (1 + k % 7)])
    return find([folder / "traces"], folder / "project.toml")[0]


def _other(path: Path, k: int) -> bytes:
    """The same record with another millisecond of time: its own content."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    t = table["t"].to_numpy() + 1e-3 * k
    memory = pa.BufferOutputStream()
    pq.write_table(table.set_column(table.schema.get_field_index("t"), "t", pa.array(t)), memory)
    return bytes(memory.getvalue().to_pybytes())


def timed(jobs: list[TraceJob], folder: Path, workers: int) -> tuple[float, list[float]]:
    """Seconds by the clock, without the start of the workers, and the time of each outcome."""
    at: list[float] = []
    run(jobs, Archive(folder), lambda n, of, last: at.append(time.perf_counter()), workers=workers,
        with_diagnosis=False)  # fmt: skip
    start = 3 * workers  # the first round compiles and imports
    return (at[-1] - at[start]) / (len(at) - 1 - start), at


def test_two_workers_are_nearly_twice_as_fast_and_memory_stays(
    jobs: list[TraceJob], tmp_path: Path
) -> None:
    """At least 80 % of two; the driver does not grow with the number of traces."""
    one, _ = timed(jobs[: len(jobs) // 2], tmp_path / "one", 1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    two, at = timed(jobs, tmp_path / "two", 2)
    grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    efficiency = one / two / 2
    third = len(at) // 3
    early, late = ((at[k + third - 1] - at[k]) / (third - 1) for k in (6, len(at) - third))
    basis = f"{len(jobs)} traces of 20 s, learned from, without diagnosis"
    leave("fleet: parallel efficiency of two workers", f"{100 * efficiency:.0f} %", "80 %", basis)
    leave("fleet: cost of the last third over the first", f"{late / early:.2f}", "constant", basis)
    leave("fleet: memory of the driver meanwhile", f"+{grown_mb:.0f} MB", "flat", basis)
    errors = [row["error"] for row in Archive(tmp_path / "two").rows() if row["error"]]
    assert len(errors) == sum(job.trace.stat().st_size < 10_000 for job in jobs)
    assert efficiency >= 0.8
    assert late < 1.25 * early


def test_killed_half_way_nothing_is_missing_and_nothing_twice(
    jobs: list[TraceJob], tmp_path: Path
) -> None:
    archive, done = Archive(tmp_path), list[str]()

    def count(n: int, of: int, last: Outcome) -> None:
        done.append(last.job.key)
        if len(done) == len(jobs) // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(jobs, archive, count, workers=2, with_diagnosis=False)
    run(jobs, archive, count, workers=2, with_diagnosis=False)
    assert sorted(done) == sorted(job.key for job in jobs)
    leave("fleet: killed half way, resumed", f"{len(done)} of {len(jobs)}, each once", "all", "")
    assert len(np.unique(done)) == len(jobs)
