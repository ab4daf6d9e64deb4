"""A small fleet: four machines of one declaration, one with worn valves, two traces each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant

WORN = "m4"
MACHINES = ("m1", "m2", "m3", WORN)
GAINS = dict(zip(MACHINES, (0.99, 1.0, 1.01, 1.15), strict=True))


def plant(machine: str) -> SimulatedPlant:
    """The default machine with all gains scaled: the same declaration fits."""
    valves = tuple(replace(v, gain=v.gain * GAINS[machine]) for v in SimulatedPlant().valves)
    return replace(SimulatedPlant(), valves=valves)


@pytest.fixture(scope="session")
def traces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders MACHINE/TRACE.parquet, and the project for all."""
    folder = tmp_path_factory.mktemp("fleet")
    for k, machine in enumerate(MACHINES):
        (folder / "traces" / machine).mkdir(parents=True)
        for day in (0, 1):
            path = folder / "traces" / machine / f"day{day}.parquet"
            write_run(path, simulate(plant(machine), "rich", 10 * k + day, 12.0), day, "rich")
            path.with_suffix(".toml").rename(folder / "project.toml")
            path.with_suffix(".truth.json").unlink(missing_ok=True)
    return folder


@pytest.fixture(scope="session")
def project(traces: Path) -> Path:
    return traces / "project.toml"
