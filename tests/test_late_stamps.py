"""Stamps that a busy computer wrote late are put back to the steady instants of their sender."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from firmware_bridge.frames import Frames
from firmware_bridge.sources import open_log, read_table
from rtid.plain import FloatArray
from rtid.project import load
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.study import Study
from rtid.trace.described import catalog_of
from rtid.trace.late_stamps import frames_in_time, rows_in_time
from rtid.trace.signals import read_recording
from rtid.trace.steady import grid_of, period_of, seen_moving

SECONDS, LATE_S = 12.0, 4e-4
KINDS = ["half-normal", "exponential", "uniform"]


def delays(kind: str, n: int) -> FloatArray:
    """How late a computer comes to n stamps, s."""
    rng = np.random.default_rng(4)
    if kind == "exponential":
        return rng.exponential(LATE_S, n)
    return np.abs(rng.normal(0, LATE_S, n)) if kind == "half-normal" else rng.uniform(0, LATE_S, n)


def stamped(t_s: NDArray[np.floating], kind: str) -> FloatArray:
    """Stamps in order, us."""
    return np.rint(1e6 * np.maximum.accumulate(t_s + delays(kind, len(t_s))))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("period_s", [1e-3, 5e-3])
def test_the_grid_is_found_beside_lost_rows(kind: str, period_s: float) -> None:
    rng = np.random.default_rng(5)
    there = np.delete(np.arange(16000), rng.choice(16000, 60, replace=False))
    there = np.delete(there, slice(3000, 3007))
    t_s = (1 + 30e-6) * period_s * there
    grid = grid_of(stamped(t_s, kind).astype(np.int64))
    assert grid is not None
    error_us = grid.t_us - 1e6 * t_s
    error_us -= np.median(error_us)
    assert np.mean(np.abs(error_us) < 30.0) > 0.99  # behind which of two late rows one is lost
    assert np.sqrt(np.mean(error_us**2)) < 80.0  # of 120 to 420 in the stamps
    assert grid.period_us == pytest.approx(1e6 * (1 + 30e-6) * period_s, rel=1e-5)
    assert period_of(stamped(t_s, kind).astype(np.int64)) == 1e6 * period_s


@pytest.mark.parametrize("is_steady", [True, False])
def test_the_sensors_say_whether_they_were_sampled_evenly(is_steady: bool) -> None:
    t_s = 1e-3 * np.arange(20000)
    t_us = stamped(t_s, "half-normal")
    rng, at = np.random.default_rng(6), t_s if is_steady else 1e-6 * t_us
    x = 0.1 * np.sin(6.0 * at) + 1e-5 * rng.standard_normal(len(at))
    grid = grid_of(t_us.astype(np.int64))
    assert grid is not None
    told = seen_moving(grid, [x])
    assert (told.says_grid, told.says_stamps) == (is_steady, not is_steady)
    for nothing in ([1e-3 * rng.standard_normal(len(at))], []):  # it stands still
        told = seen_moving(grid, nothing)
        assert not told.says_grid
        assert not told.says_stamps


def test_even_stamps_and_those_of_no_period_stay() -> None:
    t_us = 1000 * np.arange(20000)
    assert grid_of(t_us) is None
    assert grid_of(t_us[:100]) is None
    rng = np.random.default_rng(7)
    assert grid_of(np.cumsum(rng.integers(500, 1500, 20000))) is None  # each from the one before
    assert grid_of(np.cumsum(rng.exponential(1000, 20000)).astype(np.int64)) is None


def jittered_table(folder: Path) -> tuple[Path, Path]:
    """A healthy record with stamps that are late by turns, and its project; noise estimated."""
    trace = folder / "run.parquet"
    write_run(trace, simulate(SimulatedPlant(), "rich", 0, SECONDS), 0, "rich")
    table = pq.read_table(trace)
    t = read_table(trace).seconds("t")
    columns = {name: table[name] for name in table.column_names if name != "t"}
    late = {"t": pa.array(1e-6 * stamped(t, "half-normal"))}
    fields = [pa.field("t", pa.float64(), metadata={"unit": "s"})]
    fields += [field for field in table.schema if field.name != "t"]
    arrays = [(late | columns)[field.name] for field in fields]
    pq.write_table(pa.table(arrays, schema=pa.schema(fields)), trace)
    project = trace.with_suffix(".toml")
    project.write_text(re.sub(r"(?m)^noise = .*$", 'noise = "estimate"', project.read_text()))
    return project, trace


def test_a_healthy_record_with_late_stamps_leaves_its_noise(tmp_path: Path) -> None:
    """With the stamps as they were written it left 2.0 times that."""
    project, trace = jittered_table(tmp_path)
    assert Study(project, trace).fitted.rho < 1.1
    read = read_recording(load(project), trace)
    assert read.jitter_s == pytest.approx(0.6 * LATE_S, rel=0.1)
    assert read.messages[trace.name].gaps == 0


def test_rows_keep_the_stamps_at_which_they_were_sampled(tmp_path: Path) -> None:
    project, trace = jittered_table(tmp_path)
    table, assembly = read_table(trace), load(project).table_assembly
    assert assembly is not None
    moved, jitter_s = rows_in_time(table, assembly)
    assert jitter_s > 0.0
    even = 1e-3 * np.arange(len(moved.t_us()))
    at_stamps = {
        name: np.interp(table.seconds("t"), even, column) if name != "t" else column
        for name, column in table.columns.items()
    }
    table = type(table)(table.path, at_stamps, table.units)
    assert rows_in_time(table, assembly) == (table, 0.0)


def test_messages_are_put_back_to_the_instants_of_their_senders(tmp_path: Path) -> None:
    trace = tmp_path / "run.log"
    write_run(trace, simulate(SimulatedPlant(), "rich", 0, SECONDS), 0, "rich")
    project, frames = load(trace.with_suffix(".toml")), open_log(trace)
    catalog, assembly = catalog_of(project), project.assembly
    late_us = stamped(1e-6 * frames.t_us, "half-normal").astype(np.int64)
    late = Frames(late_us, frames.channel, frames.can_id, frames.length, frames.data)
    mended, jitter_s = frames_in_time(late, assembly, catalog)
    assert jitter_s == pytest.approx(0.6 * LATE_S, rel=0.1)
    for can_id in np.unique(frames.can_id):
        true, new = (f.t_us[f.can_id == can_id] for f in (frames, mended))
        assert np.std(new - true) < 60.0  # the bus's own waiting is in it: 20 to 50 us
    same, nothing = frames_in_time(frames, assembly, catalog)
    assert nothing < 1e-4
    assert len(same) == len(frames)
