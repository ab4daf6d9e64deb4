"""`rtid simulate`: what it writes can be read back, and says what is true."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import can
import numpy as np
import pyarrow.parquet
import pytest
import typer
from typer.testing import CliRunner

from firmware_bridge.assemble import Assembler
from firmware_bridge.catalog import load as load_catalog
from firmware_bridge.frames import from_messages
from firmware_bridge.playback import SendError
from rtid import project
from rtid.cli.simulate import simulate
from rtid.errors import RtidError
from rtid.model import Machine
from rtid.sim.declare import declared_model
from rtid.sim.random_plants import draw
from rtid.sim.run import simulate as run_machine
from rtid.sim.run_files import START_US
from rtid.sim.simulated_plant import SimulatedPlant
from tests.command import output_of

APP = typer.Typer()
APP.command()(simulate)


def assert_same_machine(machine: Machine, declared: Machine) -> None:
    assert [s.name for s in machine.signals] == [s.name for s in declared.signals]
    assert [s.kind for s in machine.signals] == [s.kind for s in declared.signals]
    noise = [s.noise for s in declared.signals]
    assert [s.noise for s in machine.signals] == pytest.approx(noise)
    for a, b in zip(machine.chambers, declared.chambers, strict=True):
        assert (a.name, a.pressure, a.sign) == (b.name, b.pressure, b.sign)
        assert (a.area_m2, a.v0_m3) == pytest.approx((b.area_m2, b.v0_m3), rel=1e-12)
    for e, f in zip(machine.edges, declared.edges, strict=True):
        assert (e.name, e.source, e.sink, e.command) == (f.name, f.source, f.sink, f.command)
        assert (e.direction, e.safe_band_v) == (f.direction, f.safe_band_v)
        assert np.array_equal(e.grid.u_v, f.grid.u_v)
        assert np.allclose(e.grid.dp_pa, f.grid.dp_pa, rtol=1e-9, atol=1e-3)
        assert e.rated_q_m3s == pytest.approx(f.rated_q_m3s)
    assert machine.beta_nominal_pa == pytest.approx(declared.beta_nominal_pa)
    assert machine.lag.nominal_s == pytest.approx(declared.lag.nominal_s)
    assert machine.lag.tolerance_s == pytest.approx(declared.lag.tolerance_s)


@pytest.mark.parametrize("cross_port", [False, True])
def test_log_and_project_give_the_samples_back(tmp_path: Path, cross_port: bool) -> None:
    trace = tmp_path / "run.log"
    extra = ["--cross-port"] if cross_port else []
    output_of(APP, trace, "--plant", 7, "--motion", "rich", "--duration", 1, "--seed", 3, *extra)
    plant = draw(7, cross_port=cross_port)
    expected = run_machine(plant, "rich", 3, 1.0).samples
    loaded = project.load(trace.with_suffix(".toml"))
    assert_same_machine(loaded.model, declared_model(plant, seed=3))
    with can.LogReader(trace) as reader:
        samples = Assembler(load_catalog(), loaded.assembly).push(from_messages(reader))
    assert samples.names == expected.names
    assert np.array_equal(samples.t_us, START_US + expected.t_us)
    assert np.allclose(samples.values, expected.values, rtol=1e-12, atol=1e-12)
    assert np.array_equal(samples.flags, expected.flags)


def test_table(tmp_path: Path) -> None:
    trace = tmp_path / "run.parquet"
    output_of(APP, trace, "--duration", 0.5)
    table = pyarrow.parquet.read_table(trace)
    expected = run_machine(SimulatedPlant(), "sweep", 0, 0.5).samples
    assert table.schema.field("p_a").metadata == {b"unit": b"Pa"}
    for name in expected.names:
        assert np.array_equal(table[name].to_numpy(), expected.column(name))
    assert project.load(trace.with_suffix(".toml")).table_assembly is not None


def test_truth(tmp_path: Path) -> None:
    trace = tmp_path / "run.blf"
    said = json.loads(output_of(APP, trace, "--plant", 4, "--duration", 0.1, "--json"))
    truth = json.loads((tmp_path / "run.truth.json").read_text())
    plant = draw(4)
    assert truth["beta_pa"] == said["beta_pa"] == plant.beta_pa
    maps = truth["maps"]
    for edge in plant.edges:
        expected = plant.flow(edge, maps["u_v"][20], maps["dp_pa"][5])
        assert maps["q_m3s"][edge][20][5] == pytest.approx(float(expected))
    assert {Path(f).name for f in said["files"]} == {"run.blf", "run.truth.json", "run.toml"}


def test_hidden_effects_are_told_in_the_truth_alone(tmp_path: Path) -> None:
    trace = tmp_path / "run.parquet"
    wishes = ["--hide", "internal_leakage_laminar", "--hide", "relief_valve:b=strong"]
    wishes += ["--hide", "input_delay=0.004"]
    output = output_of(APP, trace, "--duration", 1, "--motion", "rich_record", *wishes)
    assert "hidden: relief_valve at b, 2.7e-11 m3/s/Pa" in output
    truth = json.loads((tmp_path / "run.truth.json").read_text())
    told = [(h["name"], h["where"], h["strength"], h["unit"]) for h in truth["hidden"]]
    assert told == [
        ("internal_leakage_laminar", "", 2e-12, "m3/s/Pa"),
        ("relief_valve", "b", 2.7e-11, "m3/s/Pa"),
        ("input_delay", "", 0.004, "s"),
    ]
    assert truth["extra"]["delay_s"] == 0.004
    assert truth["hidden"][1]["catalogue"] == "relief_valve"
    written = project.load(tmp_path / "run.toml")
    assert "relief" not in (tmp_path / "run.toml").read_text()
    assert_same_machine(written.model, declared_model(SimulatedPlant(), seed=0))


def test_as_json_the_same_is_told(tmp_path: Path) -> None:
    trace = tmp_path / "run.parquet"
    found = json.loads(
        output_of(APP, trace, "--duration", 1, "--hide", "input_delay=0.004", "--json")
    )
    assert (found["samples"], found["frames_sent"]) == (1000, 0)
    assert [h["strength"] for h in found["hidden"]] == [0.004]
    assert [Path(f).name for f in found["files"]] == ["run.parquet", "run.truth.json", "run.toml"]


def test_what_begins_later_is_not_there_before(tmp_path: Path) -> None:
    wish = ["--hide", "internal_leakage_laminar=strong", "--duration", 2]
    tables = []
    for name, more in (("healthy", wish[2:]), ("later", [*wish, "--hide-at", 1]), ("leak", wish)):
        output_of(APP, tmp_path / f"{name}.parquet", *more)
        table = pyarrow.parquet.read_table(tmp_path / f"{name}.parquet")
        tables.append(np.column_stack([column.to_numpy() for column in table.columns]))
    healthy, later, leak = tables
    assert np.array_equal(later[:1000], healthy[:1000], equal_nan=True)
    assert not np.array_equal(leak[:1000], healthy[:1000], equal_nan=True)
    assert not np.array_equal(later[1001:], healthy[1001:], equal_nan=True)


def test_a_record_declares_its_parts(tmp_path: Path) -> None:
    output_of(APP, tmp_path / "run.parquet", "--motion", "sweep_record", "--duration", 11)
    record = tomllib.loads((tmp_path / "run.toml").read_text())["record"]
    assert record["identification_s"] == pytest.approx([0, 8])
    assert record["validation_s"] == pytest.approx([8.3, 11])


@pytest.mark.parametrize("bus", [["virtual", "--channel", "sim-live"], ["virtual:sim-live"]])
def test_live_on_a_bus(bus: list[str]) -> None:
    """Named as by `rtid run`, too."""
    with can.Bus("sim-live", interface="virtual") as receiver:
        output = output_of(APP, "--bus", *bus, "--duration", 0.05, "--speed", 0)
        assert "sent 150 frames" in output
        first = receiver.recv(0.0)
        assert first is not None and first.timestamp == START_US * 1e-6


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "nothing to do"),
        (["run.mat"], "unknown kind of trace"),
        (["no/such/run.blf"], "no such folder"),
        (["run.blf", "--motion", "dance"], "--motion dance"),
        (["run.blf", "--cross-port"], "--cross-port"),
        (["run.blf", "--hide-at", "5"], "nothing is hidden"),
        (["run.blf", "--hide", "leak"], "leak: no such effect"),
        (["run.blf", "--hide", "supply_sag=huge"], "supply_sag=huge"),
        (["run.blf", "--hide", "relief_valve:c"], "cannot sit at 'c'"),
        (["--bus", "pcan", "--channel", "PCAN_USBBUS1", "--duration", "0.1"], "must not speak"),
    ],
)
def test_wrong_arguments(arguments: list[str], said: str) -> None:
    with pytest.raises((RtidError, SendError), match=said) as caught:
        CliRunner().invoke(APP, arguments, catch_exceptions=False)
    error = caught.value
    assert isinstance(error, RtidError | SendError) and error.exit_code == 2


def test_the_command_is_listed() -> None:
    program = "from rtid.cli.main import run; run(['simulate', '--help'])"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "--plant" in done.stdout
