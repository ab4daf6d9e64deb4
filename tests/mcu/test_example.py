"""The worked integration plays a log: ticks in time, a solve in slices, a map, a loss of power."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge import lookup
from firmware_bridge.c_tables import BOARD
from firmware_bridge.protocol import Op, begin_frames, commit_frame, data_frame, frame, open_frame
from firmware_bridge.sources import candump
from rtid.mcu.emulated import Record, absent
from rtid.mcu.write import write_sources
from rtid.sim.bus import run_frames
from rtid.sim.run import Run, simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.bridge.tables import a_table
from tests.mcu.machine import Reference
from tests.mcu.records import valve

START_S, SESSION, VERSION, BLOCKS = 1_600_000_000, 77, 5, 24
NAMES = ["restored", "ticks", "longest", "latest", "solves", "kept", "answers", "version"]
REPORT = np.dtype(
    [(name, np.uint32) for name in NAMES]
    + [("rows", np.uint64), ("beta_pa", float), ("beta_sd_pa", float)]
    + [("flow_m3s", np.float32), ("stands_on", np.uint32)]
)


def download_frames(table: lookup.Table) -> list[bytes]:
    """A whole download of one map, as a sender would speak to whom nothing is lost."""
    image = lookup.image(table, 0)
    chunks = -(-len(image) // 6)
    nodes = len(table.w_v), len(table.s)
    begun = begin_frames(SESSION, 0, *nodes, len(image), VERSION, lookup.crc32(image))
    data = [data_frame(SESSION, k, image) for k in range(chunks)]
    end = frame(SESSION, Op.END, bytes([0]))
    return [open_frame(SESSION), *begun, *data, end, commit_frame(SESSION, [0], VERSION)]


def write_log(path: Path, run: Run, table: lookup.Table) -> None:
    """The machine's frames, and among them the download, two frames a millisecond from 1 s on."""
    candump.write(path, run_frames(run, start_us=START_S * 1_000_000))
    lines = path.read_text().splitlines()
    for k, data in enumerate(download_frames(table)):
        t_us = 1_000_000 + 500 * k
        stamp = f"{START_S + t_us // 1_000_000}.{t_us % 1_000_000:06}"
        lines.append(f"({stamp}) can0 700#{data.hex().upper()}")
    path.write_text("\n".join(sorted(lines, key=lambda line: line.split(")")[0])) + "\n")


def play(folder: Path) -> np.void:
    """`make play` in the package's folder; what the controller reports."""
    places = [f"OUT={folder / 'build'}", f"ESTIMATOR={folder / 'estimator'}"]
    command = ["make", "-s", *places, f"LOG={folder / 'machine.log'}", "play"]
    subprocess.run(command, check=True, cwd=BOARD.with_name("example"), timeout=200)
    return np.fromfile(folder / "build/report.bin", REPORT)[0]


def test_the_integration(tmp_path: Path) -> None:
    """Built once, played twice: ten seconds."""
    if lacking := absent():
        pytest.skip(f"no {lacking} on this machine: the controller is not emulated")
    model, table = valve(BLOCKS), a_table(12, 9)
    write_sources(tmp_path / "estimator", model, BLOCKS)
    run = simulate(SimulatedPlant(), "rich", seed=3, duration_s=5.0)
    write_log(tmp_path / "machine.log", run, table)
    told = play(tmp_path)
    columns = [run.samples.names.index(signal.name) for signal in model.signals]
    t_us = run.samples.t_us - run.samples.t_us[0]
    record = Record(t_us, run.samples.values[:, columns], np.ones(len(t_us)))
    theirs = Reference.of(model, record).solution
    assert told["rows"] == len(t_us) - 1
    assert abs(told["beta_pa"] - theirs.beta_pa[0]) <= 0.1 * told["beta_sd_pa"]
    assert told["longest"] <= 25_000
    assert told["latest"] < 500_000  # instructions of a millisecond: it has 1,000,000
    assert told["solves"] >= 8
    assert (told["version"], told["restored"]) == (VERSION, 0)
    u, source, sink = (record.values[-1, model.column(n)] for n in ("u", "p_supply", "p_a"))
    flow, stands_on = table.flow(u, source - sink)
    assert told["flow_m3s"] == pytest.approx(float(flow), rel=1e-5, abs=1e-12)
    assert told["stands_on"] == int(stands_on)
    # the power goes while the newest bank is written
    newest = tmp_path / "build" / f"bank{told['kept'] % 2}"
    newest.write_bytes(newest.read_bytes()[:-1000])
    again = play(tmp_path)
    assert again["restored"] == told["kept"] - 1
    assert again["version"] == VERSION
    assert told["rows"] < again["rows"] < 2 * told["rows"]
