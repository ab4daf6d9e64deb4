"""A position in coarse steps is learned by where it crosses them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from firmware_bridge.samples import GAP, ROW
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.project import load
from rtid.sim.declare import declared_model
from rtid.sim.recording import write_run
from rtid.sim.run import Run, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.study import Study
from rtid.trace.coarse import at_crossings, crossings, in_quick_motion
from rtid.trace.reading import read_trace
from rtid.trace.records import read_records

STEP_M, SECONDS = 5e-4, 20.0


@pytest.fixture(scope="module")
def run() -> Run:
    return simulate(SimulatedPlant(), "rich", 0, SECONDS)


def slow(seconds: float = 60.0) -> tuple[FloatArray, FloatArray]:
    """Times, s, and a position of up to 25 mm/s at 1 kHz, m."""
    t = np.linspace(0.0, seconds, int(1e3 * seconds), endpoint=False)
    return t, np.asarray(0.2 + 0.02 * np.sin(0.9 * t) + 0.004 * np.sin(2.3 * t + 1.0))


@pytest.mark.parametrize("own_m", [2e-6, 1e-5])
def test_where_it_crosses_a_position_is_known_better_than_its_step(own_m: float) -> None:
    t, x = slow()
    step = 1e-4
    noise = own_m * np.random.default_rng(1).standard_normal(len(x))
    found = crossings(step * np.round((x + noise) / step), step, np.zeros(len(x), bool))
    error = found.x_m - x[found.at]
    told = found.noise(t[found.at])
    assert np.std(error) < 0.5 * step / np.sqrt(12.0)
    assert abs(np.mean(error * np.sign(np.gradient(x)[found.at]))) < 0.1 * np.std(error)
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.1
    assert told.sd == pytest.approx(np.std(error), rel=0.15)
    assert told.analogue_sd == pytest.approx(own_m, rel=0.3)


@pytest.mark.parametrize("own_m", [0.0, 1.5e-5, 2.2e-5])
def test_quick_motion_tells_a_noise_that_makes_crossings_uneven(own_m: float) -> None:
    """It comes early or late by its own noise, which differences at these instants hide.

    27 um were told of crossings that are 31 um off, and rho was 1.49.
    """
    t, step = np.linspace(0.0, 30.0, 30_000, endpoint=False), 1e-4
    x = 0.2 * np.sin(0.8 * np.pi * t) * np.sin(0.06 * np.pi * t) ** 2
    written = x + own_m * np.random.default_rng(3).standard_normal(len(x))
    written, fresh = step * np.round(written / step), np.arange(len(x)) == 0
    found, own_m2 = crossings(written, step, fresh), in_quick_motion(written, step, fresh)
    error = found.x_m - x[found.at]
    assert found.noise(t[found.at], own_m2).sd == pytest.approx(np.std(error), rel=0.05)
    assert np.sqrt(own_m2) == pytest.approx(own_m, rel=0.25, abs=2e-6)
    assert in_quick_motion(written[:600], step, fresh[:600]) == 0.0, "too little is quick"


def coarse(run: Run, step_m: float = STEP_M) -> tuple[Machine, Run]:
    """The declared machine and the run with a position in steps."""
    samples, j = run.samples, run.samples.names.index("x")
    values = samples.values.copy()
    values[:, j] = step_m * np.round(values[:, j] / step_m)
    return declared_model(run.plant), replace(run, samples=replace(samples, values=values))


def test_its_rows_are_the_crossings_and_gaps_are_none(run: Run) -> None:
    model, written = coarse(run)
    samples = written.samples
    flags = samples.flags.copy()
    flags[5000] |= GAP
    by, noise = at_crossings(model, replace(samples, flags=flags))
    assert noise is not None
    rows = np.flatnonzero(by.flags & ROW)
    assert 300 < len(rows) < 0.2 * len(samples)
    assert (by.flags[5000] & GAP) != 0
    true = run.samples.column("x")  # with its own noise
    assert np.std(by.column("x")[rows] - true[rows]) < 0.5 * STEP_M / np.sqrt(12.0)
    assert np.abs(by.column("x") - true).max() < 2 * STEP_M
    assert np.all(np.diff(by.t_us) > 0)


def test_what_is_spread_over_its_steps_stays(run: Run) -> None:
    model, written = coarse(run, 1e-6)  # 10 um of noise
    assert at_crossings(model, written.samples)[0] is written.samples
    assert at_crossings(model, run.samples) == (run.samples, None)
    standing = replace(run.samples, values=np.tile(run.samples.values[:1], (len(run.samples), 1)))
    assert at_crossings(model, standing) == (standing, None)


def written_coarse(run: Run, trace: Path, step_m: float = STEP_M) -> Path:
    """A record of it with a position in steps, and its project with noise to be estimated."""
    write_run(trace, run, 0, "rich")
    table = pq.read_table(trace)
    field = next(f for f in table.schema if f.name.startswith("x"))
    metadata = field.metadata or {}
    scale, offset = float(metadata.get(b"scale", 1)), float(metadata.get(b"offset", 0))
    x = scale * table[field.name].to_numpy() + offset
    plain = pa.field(field.name, pa.float64(), metadata={"unit": metadata.get(b"unit", b"")})
    at = table.schema.get_field_index(field.name)
    pq.write_table(table.set_column(at, plain, pa.array(step_m * np.round(x / step_m))), trace)
    project = trace.with_suffix(".toml")
    project.write_text(re.sub(r"(?m)^noise = .*$", 'noise = "estimate"', project.read_text()))
    return project


def test_a_healthy_record_with_a_coarse_position_leaves_its_noise(tmp_path: Path) -> None:
    """As white noise its steps left 1.75 times that, and the modulus was 12 % low."""
    trace, step_m = tmp_path / "run.parquet", 1e-3
    run = simulate(SimulatedPlant(), "sweep", 0, SECONDS)
    study = Study(written_coarse(run, trace, step_m), trace)
    x = study.machine.signals[study.machine.column("x")]
    assert np.hypot(x.noise, x.resolution / np.sqrt(12.0)) < 0.3 * step_m / np.sqrt(12.0)
    assert study.fitted.rho < 1.1
    assert 1.0 / study.fitted.compliance == pytest.approx(run.plant.beta_pa, rel=0.05)


def test_several_records_are_joined_at_their_crossings(run: Run, tmp_path: Path) -> None:
    first, second = tmp_path / "run.parquet", tmp_path / "more.parquet"
    project = load(written_coarse(run, first))
    written_coarse(run, second)
    joined, _ = read_records(project, [first, second])
    alone = read_trace(project, first)
    assert joined.crossed == alone.crossed == {"x"}
    assert joined.noise["x"].resolution == pytest.approx(alone.noise["x"].resolution)
