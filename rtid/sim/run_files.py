"""Runs into files: a CAN log, a table, and the truth beside it.

A BLF file holds its start with milliseconds and only if it lies after 1990: stamps start at a round
date, so that BLF and candump tell the same absolute time.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet

from firmware_bridge.frames import Frames, to_messages
from firmware_bridge.sources import blf, candump
from rtid.sim.declare import UNITS
from rtid.sim.extra_physics import Planted
from rtid.sim.hidden import HIDDEN
from rtid.sim.run import NAMES, Run
from rtid.sim.simulated_plant import EDGES, SimulatedPlant

START_US = 1_600_000_000_000_000
BULK_WRITERS = {".blf": blf.write, ".log": candump.write}
SUFFIXES = (*BULK_WRITERS, ".asc")
MAP_U_V = np.arange(0.0, 10.01, 0.25)
MAP_DP_PA = np.array([0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]) * 1e6


def write_log(path: Path, frames: Frames) -> None:
    """Write all frames; the suffix names the format.  Raises ValueError for an unknown one."""
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{path}: unknown kind of log; use one of {', '.join(SUFFIXES)}")
    if path.suffix in BULK_WRITERS:
        BULK_WRITERS[path.suffix](path, frames)
        return
    with can.Logger(path) as log:
        for message in to_messages(frames):
            log.on_message_received(message)


def write_table(path: Path, run: Run) -> None:
    """Write the samples as Parquet: `t` in seconds and one column per signal, unit as metadata."""
    samples = run.samples
    columns = [samples.t_us * 1e-6, *samples.values.T]
    fields = [
        pa.field(name, pa.float64(), metadata={"unit": unit})
        for name, unit in zip(("t", *NAMES), ("s", *UNITS), strict=True)
    ]
    table = pa.table([pa.array(column) for column in columns], schema=pa.schema(fields))
    pyarrow.parquet.write_table(table, path)


def truth_of(plant: SimulatedPlant) -> dict[str, Any]:
    """What an estimate is scored against: bulk modulus, lag, the true map of each edge, effects.

    maps: q_m3s[edge] is a list over u_v of lists over dp_pa; hidden: one entry per effect; extra:
    the numbers of `rtid.sim.extra_physics` that are not zero.
    """
    q_m3s = {
        edge: plant.flow(edge, MAP_U_V[:, None], MAP_DP_PA[None, :]).tolist()
        for edge in plant.edges
    }
    return {
        "beta_pa": plant.beta_pa,
        "lag_s": plant.lag_s,
        "p_supply_pa": plant.p_supply_pa,
        "constants": plant.constants._asdict(),
        "valves": {edge: asdict(valve) for edge, valve in zip(EDGES, plant.valves, strict=True)},
        "hidden": [_told(planted) for planted in plant.hidden],
        "extra": {name: value for name, value in plant.extra._asdict().items() if np.any(value)},
        "maps": {"u_v": MAP_U_V.tolist(), "dp_pa": MAP_DP_PA.tolist(), "q_m3s": q_m3s},
    }


def _told(planted: Planted) -> dict[str, Any]:
    effect = HIDDEN[planted.name]
    document = {"form": effect.form, "unit": effect.unit, "catalogue": effect.catalogue}
    return planted._asdict() | document
