"""A record whose logger has filtered its sensors: that is told, and their noise before it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.checked import checked

CUT_HZ, SENSORS = 80.0, ("p_a", "p_b", "p_supply", "x")


def test_the_noise_of_filtered_sensors_is_that_before_the_filter(tmp_path: Path) -> None:
    """A fiftieth of it was told, and the fit ended on such weights; then what the filter left."""
    run = simulate(SimulatedPlant(), "sweep", 0, 20.0)
    values = run.samples.values.copy()
    for name in SENSORS:
        k = run.samples.names.index(name)
        begin = values[0, k]
        values[:, k] = begin + lfilter(*butter(2, CUT_HZ / 500.0), values[:, k] - begin)
    study, report = checked(run, replace(run.samples, values=values), tmp_path)
    said = {
        f.subject for f in report.findings if re.match(r"was filtered at about (7|8)\d Hz", f.text)
    }
    assert len(said) >= 3 and said <= set(SENSORS)  # motion hides the one or the other
    noise = {s.name: np.hypot(s.noise, s.resolution / np.sqrt(12.0)) for s in study.machine.signals}
    assert noise["p_a"] == pytest.approx(5e3, rel=0.1)
    assert noise["x"] == pytest.approx(1e-5, rel=0.1)
