"""A record whose logger has filtered its sensors: their noise is told, and that they were."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from rtid.project import load
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.study import Study
from rtid.trace.check import judge
from rtid.trace.signals import read_recording

CUT_HZ, SENSORS = 80.0, ("p_a", "p_b", "p_supply", "x")
LEFT = 0.42  # of the deviation of white noise at 1 kHz


def test_the_noise_of_filtered_sensors_is_their_own(tmp_path: Path) -> None:
    """A fiftieth of it was told, and the fit ended on such weights."""
    run = simulate(SimulatedPlant(), "sweep", 0, 20.0)
    values = run.samples.values.copy()
    for name in SENSORS:
        k = run.samples.names.index(name)
        begin = values[0, k]
        values[:, k] = begin + lfilter(*butter(2, CUT_HZ / 500.0), values[:, k] - begin)
    trace = tmp_path / "run.parquet"
    write_run(trace, replace(run, samples=replace(run.samples, values=values)), 0, "sweep")
    file = trace.with_suffix(".toml")
    file.write_text(re.sub(r"(?m)^noise = .*$", 'noise = "estimate"', file.read_text()))
    project = load(file)
    read, stroke_m = read_recording(project, trace), project.sections.stroke_m
    every = (read.samples, read.series, read.messages, read.refused)
    report = judge(project.model, project.table_assembly or project.assembly, *every, stroke_m)
    said = {
        f.subject for f in report.findings if re.match(r"was filtered at about [78]\d Hz", f.text)
    }
    assert len(said) >= 3 and said <= set(SENSORS)  # motion hides the one or the other
    study = Study(file, trace)
    noise = {s.name: np.hypot(s.noise, s.resolution / np.sqrt(12.0)) for s in study.machine.signals}
    assert noise["p_a"] == pytest.approx(LEFT * 5e3, rel=0.3)
    assert noise["x"] == pytest.approx(LEFT * 1e-5, rel=0.3)
