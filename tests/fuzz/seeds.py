"""Sound inputs that the fuzz mutates: projects, DBCs, logs and tables of all formats, plant files.

All are made here by `rtid simulate` and by hand, so that a seed gives the same inputs everywhere.
"""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import can
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from scipy.io import savemat

import rtid.project
from firmware_bridge.catalog import CONTROLLER_DBC
from firmware_bridge.frames import Frames, to_messages
from firmware_bridge.sources import blf, open_log
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.bridge import canopen
from tests.fuzz.command import call

EXAMPLES = Path(rtid.project.__file__).parent / "examples"
LOGS = (
    *(".blf", ".log", ".asc", ".trc", ".csv", ".mf4"),
    *(".asc.gz", ".savvy.csv", ".shown.log", ".fd.log"),
)
TABLES = (".parquet", ".csv", ".mat", ".tsv", ".mcap", ".mf4")
LOG_S, TABLE_S = "0.5", "12"  # a log that is read in no time; a table in which quick finds enough
EVERY = 20  # rows of the table at 1 kHz of which one is kept


@dataclass(frozen=True)
class Seeds:
    """Folder of the sound inputs, the frames of each of its logs, the rows of each of its tables.

    projects: the commented example with all of its suggestions, what `simulate` writes with its own
    DBC, and one for tables.  plants: a plant file each, with its record (.csv).
    """

    folder: Path
    frames: int
    rows: int
    projects: tuple[str, ...] = ("cylinder.toml", "log.toml", "table.toml")
    plants: tuple[str, ...] = ("cascaded_tanks", "electric_drive", "heated_room")


def make(folder: Path) -> Seeds:
    """Write all sound inputs into `folder`."""
    frames = _logs(folder)
    rows = _tables(folder)
    _projects(folder)
    _plants(folder)
    run = simulate(SimulatedPlant(), "rich", 0, 2.0)
    names = ("u", "x", "v", "p_a", "p_b", "p_supply")
    canopen.machine(folder)
    blf.write(folder / "nodes.blf", canopen.bus({n: run.samples.column(n)[::10] for n in names}))
    return Seeds(folder, frames, rows)


def _logs(folder: Path) -> int:
    _done("simulate", str(folder / "log.blf"), "--duration", LOG_S, "--motion", "rich")
    frames = open_log(folder / "log.blf")
    for suffix in (".log", ".asc", ".trc", ".csv", ".mf4"):
        with can.Logger(folder / f"log{suffix}") as log:
            for message in to_messages(frames):
                log.on_message_received(message)
    _without_today(folder / "log.asc", rb"date .*", b"date Sun Sep 13 12:26:40.0 2020")
    _without_today(folder / "log.trc", rb";   /.*", b";   log.trc")
    (folder / "log.savvy.csv").write_text("".join(_as_savvy(frames)))
    (folder / "log.shown.log").write_text("".join(_as_shown(frames)))
    long = (folder / "log.log").read_text().replace("#", "##0").splitlines()
    (folder / "log.fd.log").write_text("".join(f"{line}\n" for line in long))
    (folder / "log.asc.gz").write_bytes(gzip.compress((folder / "log.asc").read_bytes(), mtime=0))
    return len(frames)


def _as_savvy(frames: Frames) -> Iterator[str]:
    yield "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
    for k in range(len(frames)):
        payload = frames.data[k, : frames.length[k]].tobytes().hex(",").upper()
        stamp = int(frames.t_us[k] - frames.t_us[0])
        yield f"{stamp},{int(frames.can_id[k]):08X},false,Rx,0,{frames.length[k]},{payload},\n"


def _as_shown(frames: Frames) -> Iterator[str]:
    for k in range(len(frames)):
        payload = frames.data[k, : frames.length[k]].tobytes().hex(" ").upper()
        stamp, size = 1e-6 * float(frames.t_us[k]), frames.length[k]
        yield f" ({stamp:.6f})  can0  {int(frames.can_id[k]):03X}   [{size}]  {payload}\n"


def write_mcap(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Columns with their time as a topic in JSON each, as an MCAP file."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        log = Writer(file)
        log.start()
        schema = log.register_schema("number", "jsonschema", b"{}")
        time = next(iter(columns.values()))
        for name, column in list(columns.items())[1:]:
            channel = log.register_channel(name, "json", schema)
            for t, value in zip(time, column, strict=True):
                is_usable = time.dtype.kind != "U" and np.isfinite(t) and abs(t) < 1e9
                stamp = int(1e9 * abs(float(t))) if is_usable else 0
                cell = str(value) if column.dtype.kind == "U" else float(value)  # text is a string
                log.add_message(channel, stamp, json.dumps(cell).encode(), stamp)
        log.finish()


def write_mf4(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Columns with their time as a measurement, as an MF4 file."""
    from asammdf import MDF, Signal

    time = next(iter(columns.values()))
    with MDF(version="4.10") as log:
        log.start_time = datetime(2020, 9, 13, tzinfo=UTC)
        log.append([Signal(c, time, name=name) for name, c in list(columns.items())[1:]])
        log.save(path)


def _without_today(path: Path, pattern: bytes, line: bytes) -> None:
    """One seed gives the same bytes on each day and in each folder."""
    path.write_bytes(re.sub(pattern, line, path.read_bytes(), count=1))


def _tables(folder: Path) -> int:
    _done("simulate", str(folder / "table.parquet"), "--duration", TABLE_S, "--motion", "rich")
    whole = pyarrow.parquet.read_table(folder / "table.parquet")
    kept = whole.take(pa.array(range(0, whole.num_rows, EVERY)))
    pyarrow.parquet.write_table(kept, folder / "table.parquet")
    pyarrow.csv.write_csv(kept, folder / "table.csv")
    tabs = pyarrow.csv.WriteOptions(delimiter="\t")
    pyarrow.csv.write_csv(kept, folder / "table.tsv", tabs)
    columns = {name: kept[name].to_numpy() for name in kept.column_names}
    savemat(folder / "table.mat", columns, do_compression=True)
    write_mcap(folder / "table.mcap", columns)
    write_mf4(folder / "table.mf4", columns)
    return kept.num_rows


def _projects(folder: Path) -> None:
    """`simulate` has written log.toml and table.toml; the first gets a DBC of its own."""
    dbc = CONTROLLER_DBC.read_text("utf-8")
    (folder / "machine.dbc").write_text(dbc)
    text = (folder / "log.toml").read_text("utf-8")
    (folder / "log.toml").write_text(text.replace("builtin:controller.dbc", "machine.dbc"))
    text = (EXAMPLES / "cylinder.toml").read_text("utf-8")
    (folder / "cylinder.toml").write_text(with_suggestions(text))


def with_suggestions(text: str) -> str:
    """The commented example with what it offers in comments as live lines, but files."""
    value = r'(?:"[^"]*"|[-\d.e]+|0x\d+|true|\[[^\]]*\]|\{[^}]*\})'
    offered = re.sub(rf"(?m)^# (?=\[\w+\S*\]$|\w+ = {value}\s*(?:#.*)?$)", "", text)
    files = r"(?m)^(\[project\]\neffects_module.*|\[prior\]\nmap.*\nerror_percent.*)\n"
    return re.sub(files, "", offered)


def _plants(folder: Path) -> None:
    for name in ("electric_drive", "heated_room"):
        _done("simulate", str(folder / f"{name}.csv"), "--example", name)
        (folder / f"{name}.toml").write_text((EXAMPLES / f"{name}.toml").read_text("utf-8"))
    (folder / "cascaded_tanks.toml").write_text((EXAMPLES / "cascaded_tanks.toml").read_text())
    (folder / "cascaded_tanks.csv").write_text(_tanks_table())


def _tanks_table(n: int = 200, dt_s: float = 4.0) -> str:
    """Two records of the tanks of the example, Euler steps, for the columns that it names."""
    columns = [dt_s * np.arange(n)]
    for phase in (0.0, 1.0):
        u = 2.5 + np.sin(0.02 * columns[0] + phase)
        upper, lower = 4.0, 5.0
        y = np.empty(n)
        for k in range(n):
            y[k] = lower
            out = 0.05 * np.sqrt(max(upper, 0.0))
            upper += dt_s * (0.05 * u[k] - out)
            lower += dt_s * (out - 0.05 * np.sqrt(max(lower, 0.0)))
        columns += [u, y + 1e-3 * np.cos(37.0 * np.arange(n))]
    rows = [",".join(f"{value:.6g}" for value in row) for row in zip(*columns, strict=True)]
    return "\n".join(["t_s,u_est_V,y_est_V,u_val_V,y_val_V", *rows]) + "\n"


def _done(*arguments: str) -> None:
    found = call(arguments)
    assert found.code == 0, found
