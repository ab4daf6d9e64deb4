"""Healthy machines in logs that are slower than their controller, as their users would ask `quick`.

The controller commands 1000 times a second, the log has each k-th sample, of sensors of 12 bits.
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rtid.sim.demand import DT_S
from rtid.sim.run import SimulationError, simulate
from rtid.sim.valve_laws import LAWS
from rtid.study.quick import Quick, quick
from rtid.study.quick_machine import Given
from tests.campaign.laws import Case
from tests.campaign.laws_at_size import ALARMS, MOTIONS
from tests.campaign.report import leave

pytestmark = pytest.mark.campaign
SEED, RECORD_S, LAG_S = 6203, 60.0, 1.3e-3
TOO_SLOW = pytest.mark.xfail(reason="none matches: what the oil does between the samples")
SPANS = dict.fromkeys(("p_a", "p_b", "p_supply", "p_tank"), 40e6)  # of 12 bits, Pa; x: the stroke
NAMED = ("missing", "ambiguous")


def logged(path: Path, case: Case, rate_hz: int) -> Given:
    """Write what the logger has, and say what its user knows; SimulationError if it is none."""
    plant, every = case.plant, round(1.0 / (DT_S * rate_hz))
    samples = simulate(plant, case.motion, case.seed, RECORD_S, case.sensors).samples
    c = plant.constants
    columns = {"t_s": 1e-6 * samples.t_us, "u_v": samples.column("u")}
    for name, span in (SPANS | {"x": c.stroke_m}).items():
        step = span / 4096
        columns[f"{name}_{'m' if name == 'x' else 'pa'}"] = step * np.round(
            samples.column(name) / step
        )
    pq.write_table(pa.table({name: values[::every] for name, values in columns.items()}), path)
    bore_m = math.sqrt(4 / math.pi * c.area_a_m2)
    rod_m = math.sqrt(bore_m**2 - 4 / math.pi * c.area_b_m2)
    return Given(bore_m, rod_m, c.stroke_m, (c.v0_a_m3, c.v0_b_m3), None, LAG_S)


@pytest.mark.parametrize("rate_hz", [200, 100, pytest.param(50, marks=TOO_SLOW)])
def test_healthy_machines(tmp_path: Path, rate_hz: int) -> None:
    """At most one in ten is said to miss something; what is said goes into the table."""
    said, wrong = Counter[str](), []
    for law in LAWS:
        for motion in MOTIONS.values():
            path = tmp_path / f"{law}_{motion}.parquet"
            try:
                given = logged(path, Case(SEED, law, motion), rate_hz)
            except SimulationError:
                continue
            looked = quick(path, None, given)
            assert isinstance(looked, Quick)
            verdict = looked.diagnosis.verdict if looked.diagnosis else "none"
            said[verdict] += 1
            if looked.diagnosis and verdict in NAMED:
                wrong += [f"{law}: {found.effect}" for found in looked.diagnosis.found]
    words = ", ".join(f"{verdict} {n}" for verdict, n in said.most_common())
    text = f"{words}; wrong names: {', '.join(wrong) or 'none'}"
    leave(
        f"logs of {rate_hz} Hz beside a controller of 1 kHz, healthy machines of ten laws", text,
        "no alarm", f"{said.total()} machines, rich motion and sweeps, 12 bits, 60 s",
    )  # fmt: skip
    assert sum(said[alarm] for alarm in ALARMS) <= 0.1 * said.total()
