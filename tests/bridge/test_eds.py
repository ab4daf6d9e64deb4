"""CANopen: a cylinder whose valve, pressure sensors and encoder are nodes, by their EDS and DCF."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge import catalog as catalogs
from firmware_bridge.catalog import CatalogError
from firmware_bridge.sources import blf
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from tests.bridge.canopen import bus, machine
from tests.command import said


def test_limits_are_the_range_of_a_signal(tmp_path: Path) -> None:
    """-2 to 3 bar at two decimals; limits without room between them say nothing."""
    names = machine(tmp_path).split(",")[1]
    path = Path(names.partition(":")[0])
    limits = {1: ("0xFF38", "300"), 2: ("0", "0"), 3: ("abc", "5")}
    text = path.read_text()
    for k, (low, high) in limits.items():
        head = f"[7130sub{k}]\n"
        text = text.replace(head, f"{head}LowLimit={low}\nHighLimit={high}\n")
    path.write_text(text)
    data = np.array([-201, -200, 300, 301], "<i2").repeat(3).view(np.uint8).reshape(4, 6)
    data = np.pad(data, ((0, 0), (0, 2)))
    values = catalogs.load(names).layouts("TPDO1").decode(data)
    assert np.isfinite(values[:, 0]).tolist() == [False, True, True, False]
    assert np.isfinite(values[:, 1:]).all()


def test_a_cylinder_on_canopen_is_read_by_its_eds(tmp_path: Path) -> None:
    run = simulate(SimulatedPlant(), "rich", 0, 20.0)
    names = ("u", "x", "v", "p_a", "p_b", "p_supply")
    columns = {name: run.samples.column(name)[::10] for name in names}
    blf.write(tmp_path / "run.blf", bus(columns))
    nodes = machine(tmp_path)
    code, out, err = said("check", "--bus-only", tmp_path / "run.blf", "--dbc", nodes, "--json")
    assert code == 0, err
    report = json.loads(out)
    found = {s["name"]: (s["unit"], s["minimum"], s["maximum"]) for s in report["signals"]}
    for signal, unit, name, si, step in (
        ("TPDO1-189.AI_Input_PV_Cylinder_piston_pressure", "bar", "p_a", 1e5, 0.01),
        ("TPDO1-18A.Position_Value", "mm", "x", 1e-3, 0.01),
        ("TPDO1-18A.Speed_Value_Channel_1", "mm/s", "v", 1e-3, 0.1),
        ("RPDO1.vpoc_set_point_Value", "", "u", 1e-3, 1.0),
    ):
        told, low, high = found[signal]
        assert told == unit
        assert low == pytest.approx(columns[name].min() / si, abs=step)
        assert high == pytest.approx(columns[name].max() / si, abs=step)
    taken = [(t["file"], t["messages"], t["present"]) for t in report["described"]["taken"]]
    assert taken == [("valve.eds:5", 1, 1), ("sensor.eds:9", 1, 1), ("encoder.dcf", 1, 1)]
    code, out, err = said("init", nodes, "-o", tmp_path / "cylinder.toml")
    assert code == 0, err
    for role, signal in (
        ("p_supply", "TPDO1-189.AI_Input_PV_Pump_pressure [bar]"),
        ("p_a", "TPDO1-189.AI_Input_PV_Cylinder_piston_pressure [bar]"),
        ("p_b", "TPDO1-189.AI_Input_PV_Cylinder_rod_pressure [bar]"),
        ("x", "TPDO1-18A.Position_Value [mm]"),
        ("v", "TPDO1-18A.Speed_Value_Channel_1 [mm/s]"),
        ("u", "RPDO1.vpoc_set_point_Value"),
    ):
        assert f"  {role:9} {signal}" in out, out
    code, out, err = said("quick", tmp_path / "run.blf", "--dbc", nodes, "--json")
    assert code in (0, 4), err
    assert json.loads(out)["data"]["level"] != "bad", out


def test_an_eds_that_lacks_something_says_what(tmp_path: Path) -> None:
    machine(tmp_path)
    with pytest.raises(CatalogError, match=r"add its node id, as in valve\.eds:5"):
        catalogs.load(tmp_path / "valve.eds")
    for node in ("0", "128", "x", ""):
        with pytest.raises(CatalogError, match="no node id; give 1 to 127"):
            catalogs.load(f"{tmp_path}/valve.eds:{node}")
    (tmp_path / "other.eds").write_text("[Nothing]\nx=1\n")
    with pytest.raises(CatalogError, match=r"no section \[FileInfo\]"):
        catalogs.load(f"{tmp_path}/other.eds:1")
    for text, wanted in (("0x63000110", "0x6300Q110"), ("0x63000110", "0x630001FF")):
        broken = (tmp_path / "valve.eds").read_text().replace(text, wanted)
        (tmp_path / "broken.eds").write_text(broken)
        with pytest.raises(CatalogError, match=r"broken\.eds: \[1600"):
            catalogs.load(f"{tmp_path}/broken.eds:1")
