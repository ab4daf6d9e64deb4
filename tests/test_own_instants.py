"""What nobody has declared of a sensor is told at the instants at which it was measured."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rtid.sim.recording import write_run
from rtid.sim.run import Sensors, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.study import Study


def test_the_noise_of_what_is_told_in_turn_is_the_sensors(tmp_path: Path) -> None:
    """On the line between two values there is next to none: healthy machines were `unknown`."""
    trace = tmp_path / "run.parquet"
    write_run(trace, simulate(SimulatedPlant(), "rich", 0, 12.0), 0, "rich")
    table = pq.read_table(trace)
    is_even = np.arange(len(table)) % 2 == 0
    columns = {name: table[name].to_numpy().astype(float) for name in table.column_names}
    for name, values in columns.items():
        if name.startswith("p_"):
            values[~is_even] = np.nan
        elif name.startswith("x"):
            values[is_even] = np.nan
    pq.write_table(pa.table(columns), trace)
    project = trace.with_suffix(".toml")
    declared = re.sub(r"(?m)^noise = .*$", 'noise = "estimate"', project.read_text())
    assert declared.count('noise = "estimate"') >= 3
    project.write_text(declared)
    study = Study(project, trace)
    found = {s.name: s.noise for s in study.machine.signals}
    assert found["p_a"] == pytest.approx(Sensors().p_noise_pa, rel=0.1)
    assert found["p_b"] == pytest.approx(Sensors().p_noise_pa, rel=0.1)
    assert found["x"] == pytest.approx(Sensors().x_noise_m, rel=0.1)
    assert study.fitted.rho < 1.1
