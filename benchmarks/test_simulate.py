"""The simulated machine: 80 s of the paper's sweep in a second, beside learning from them."""

from __future__ import annotations

from typing import Any

from benchmarks.interleave import Job, side_by_side
from benchmarks.machine import COARSE, chunk, empty, model
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant

SIMULATED, LEARNED = "80 s simulated", "learned from them, on board"
MOST_S = 1.0


def test_simulate(benchmark: Any) -> None:
    data, machine = chunk(simulate(SimulatedPlant(), "sweep").samples), model(COARSE)
    jobs = [
        Job(SIMULATED, lambda: simulate(SimulatedPlant(), "sweep")),
        Job(LEARNED, lambda: empty(machine).advance(data)),
    ]
    times = side_by_side(
        benchmark, "The simulated machine, 80 s at 1 kHz", "run", jobs, LEARNED, 5,
        {SIMULATED: f"{MOST_S:g} s"},
    )  # fmt: skip
    assert min(times[SIMULATED]) < MOST_S
