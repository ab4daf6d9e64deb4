"""The converter from tables to CAN logs: exact stamps, exact values, honest sidecar."""

import json
import subprocess
import sys
from pathlib import Path

import can
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from typer.testing import CliRunner

from firmware_bridge.catalog import load
from firmware_bridge.frames import Frames, from_messages
from rtid.sim.frames import CONTROLLER_ROUTES, cycle_frames
from rtid.sim.run_files import START_US, write_log
from tests.command import output_of
from tests.rig import CONVERTER, ROOT
from tools import table_to_can

N = 3000
RIG = Path(__file__).parents[1].parent / "shared" / "data" / "rig" / "measured" / "rig_01.parquet"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """3 s of integer columns with scale and offset, as a logger writes them."""
    k = np.arange(N)
    scales = {"t": 1e-3, "u": 20 / 65535, "p_A": 1e7 / 65535, "x": 0.5 / 65535}
    offsets = {"u": -10.0}
    fields = [
        pa.field(
            name, pa.int32(), metadata={"scale": repr(s), "offset": repr(offsets.get(name, 0))}
        )
        for name, s in scales.items()
    ]
    columns = [k, (k * 7) % 65536, 10_000 + 15 * k, 20_000 + 3 * k]
    path = tmp_path / "run.parquet"
    table = pa.table([pa.array(c, pa.int32()) for c in columns], schema=pa.schema(fields))
    pa.parquet.write_table(table, path)
    return path


def convert(*arguments: object) -> str:
    return output_of(CONVERTER, *arguments)


def read(path: Path) -> Frames:
    with can.LogReader(path) as reader:
        return from_messages(reader)


def decoded(frames: Frames, message: str, signal: str) -> tuple[np.ndarray, np.ndarray]:
    catalog = load()
    mine = frames[frames.can_id == catalog.can_id(message)]
    return mine.t_us - START_US, catalog.layouts(message, [signal]).decode(mine.data)[:, 0]


@pytest.mark.parametrize("suffix", ["blf", "log"])
def test_cycle_mode_keeps_every_count(table: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"run.{suffix}"
    convert(table, out, "--seed", 5)
    frames = read(out)
    assert len(frames) == 3 * N
    t_us, p_a = decoded(frames, "Pressures", "PA")
    assert np.abs(t_us - 1000 * np.arange(N) - 130 - 32.5).max() <= 32.5
    assert np.array_equal(np.rint(p_a / (1e7 / 65535)), 10_000 + 15 * np.arange(N))
    _, u = decoded(frames, "ValveCommand", "U")
    assert np.array_equal(np.rint((u + 10) / (20 / 65535)), (np.arange(N) * 7) % 65536)


def test_both_formats_hold_the_same_microseconds(table: Path, tmp_path: Path) -> None:
    for name in ("run.blf", "run.log"):
        convert(table, tmp_path / name, "--mode", "multirate", "--seed", 2)
    blf, candump = read(tmp_path / "run.blf"), read(tmp_path / "run.log")
    assert np.array_equal(blf.t_us, candump.t_us)
    assert np.array_equal(blf.data, candump.data)


def test_multirate_sidecar_tells_the_true_offsets(table: Path, tmp_path: Path) -> None:
    """p_A rises linearly: its value tells when it was read."""
    out = tmp_path / "run.log"
    convert(table, out, "--mode", "multirate", "--offset", "Motion=2.5", "--rate", "Pressures=500")
    truth = json.loads(out.with_suffix(".json").read_text())
    assert truth["mode"] == "multirate"
    assert truth["messages"]["Motion"]["offset_s"] == pytest.approx(2.5e-3)
    t_us, p_a = decoded(read(out), "Pressures", "PA")
    age_s = np.mean(t_us * 1e-6 - (p_a / (1e7 / 65535) - 10_000) / 15 * 1e-3)
    assert age_s == pytest.approx(truth["messages"]["Pressures"]["mean_age_s"], abs=1e-5)
    assert len(t_us) == pytest.approx(1500, abs=2)


def test_same_seed_same_log(table: Path, tmp_path: Path) -> None:
    logs = []
    for name, seed in (("a.log", 1), ("b.log", 1), ("c.log", 2)):
        convert(table, tmp_path / name, "--mode", "multirate", "--seed", seed)
        logs.append((tmp_path / name).read_bytes())
    assert logs[0] == logs[1] != logs[2]


def test_own_dbc_and_csv(table: Path, tmp_path: Path) -> None:
    dbc, csv = tmp_path / "own.dbc", tmp_path / "run.csv"
    dbc.write_text(
        'VERSION ""\nNS_ :\nBS_:\nBU_: E\n'
        'BO_ 2566844926 Body: 8 E\n SG_ Load : 7|16@0+ (0.01,-10) [-10|600] "bar" E\n'
    )
    csv.write_text("t,p\n0.0,1e5\n0.1,2e5\n")
    convert(csv, tmp_path / "own.log", "--dbc", dbc, "--map", "p=Body.Load*1e-5")
    frames = read(tmp_path / "own.log")
    assert frames.can_id.tolist() == [2566844926, 2566844926]
    assert [int.from_bytes(row[:2], "big") for row in frames.data] == [1100, 1200]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--map", "q=Pressures.PA"], "no column q"),
        (["--map", "u=ValveCommand"], "column=Message.Signal"),
        (["--mode", "multirate", "--offset", "Motion=soon"], "not a number"),
        (["--mode", "multirate", "--rate", "Motoin=3"], "no such message"),
        (["--time-column", "clock"], "no column clock"),
    ],
)
def test_wrong_arguments_are_named(
    table: Path, tmp_path: Path, arguments: list[str], said: str
) -> None:
    out = tmp_path / "never.log"
    result = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(
        CONVERTER, [str(table), str(out), *arguments]
    )
    assert result.exit_code == 2
    assert said in " ".join(result.output.split())
    assert not out.exists()


def test_unknown_log_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="use one of"):
        write_log(tmp_path / "run.xyz", from_messages([]))


def test_it_is_a_command(table: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tools.table_to_can"]
    command += [str(table), str(tmp_path / "command.blf")]
    subprocess.run(command, check=True, capture_output=True, cwd=ROOT)
    convert(table, tmp_path / "here.blf")
    assert (tmp_path / "command.blf").read_bytes() == (tmp_path / "here.blf").read_bytes()


def test_the_help_tells_the_modes() -> None:
    documentation = table_to_can.__doc__ or ""
    assert "multirate" in documentation and "jitter" in documentation


@pytest.mark.skipif(not RIG.exists(), reason="needs ../shared/data/rig")
def test_a_rig_run_survives_exactly() -> None:
    """Every integer count of the table comes back from the frames."""
    columns = table_to_can.read_table(RIG)
    routes = {n: r for n, r in CONTROLLER_ROUTES.items() if n in columns}
    t_us = np.rint(columns["t"] * 1e6).astype(np.int64)
    frames = cycle_frames(load(), routes, columns, t_us + START_US)
    assert len(routes) == 8 and len(frames) == 3 * len(t_us)
    for name, route in routes.items():
        stamps, values = decoded(frames, route.message, route.signal)
        assert np.array_equal(stamps, t_us)
        assert np.abs(values - columns[name]).max() < 1e-6 * np.abs(columns[name]).max()
