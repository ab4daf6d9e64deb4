"""A record whose logger has filtered its sensors: their noise is told, and that they were."""

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
LEFT = 0.42  # of the deviation of white noise at 1 kHz


def test_the_noise_of_filtered_sensors_is_their_own(tmp_path: Path) -> None:
    """A fiftieth of it was told, and the fit ended on such weights."""
    run = simulate(SimulatedPlant(), "sweep", 0, 20.0)
    values = run.samples.values.copy()
    for name in SENSORS:
        k = run.samples.names.index(name)
        begin = values[0, k]
        values[:, k] = begin + lfilter(*butter(2, CUT_HZ / 500.0), values[:, k] - begin)
    study, report = checked(run, replace(run.samples, values=values), tmp_path)
    said = {
        f.subject for f in report.findings if re.match(r"was filtered at about [78]\d Hz", f.text)
    }
    assert len(said) >= 3 and said <= set(SENSORS)  # motion hides the one or the other
    noise = {s.name: np.hypot(s.noise, s.resolution / np.sqrt(12.0)) for s in study.machine.signals}
    assert noise["p_a"] == pytest.approx(LEFT * 5e3, rel=0.3)
    assert noise["x"] == pytest.approx(LEFT * 1e-5, rel=0.3)
