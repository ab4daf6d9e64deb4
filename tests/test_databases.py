"""Several databases on a bus, one identifier on two channels, one message from two senders."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.catalog import CONTROLLER_DBC
from firmware_bridge.frames import EXTENDED
from firmware_bridge.sources import blf, open_log
from rtid.project import load
from rtid.trace.reading import read_trace
from tests.command import said


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A log of the simulated cylinder, and its DBC in two files: Pressures in the second."""
    code, _, err = said("simulate", tmp_path / "run.blf", "--duration", 2)
    assert code == 0, err
    text = CONTROLLER_DBC.read_text()
    pressures = re.search(r"BO_ 289 .*?\n\n", text, re.S)
    assert pressures is not None
    head = text[: text.index("BO_ 288")]
    (tmp_path / "b.dbc").write_text(head + pressures[0])
    (tmp_path / "a.dbc").write_text(re.sub(r"(?m)^.* 289 .*\n( SG_.*\n)*", "", text))
    return tmp_path


def edited(folder: Path, *pairs: tuple[str, str]) -> Path:
    """The project with these texts replaced."""
    text = (folder / "run.toml").read_text()
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    (folder / "edited.toml").write_text(text)
    return folder / "edited.toml"


def key(message: str, line: str) -> tuple[str, str]:
    return f"[messages.{message}]\n", f"[messages.{message}]\n{line}\n"


def test_two_databases_describe_one_bus(machine: Path) -> None:
    project = edited(
        machine, ("builtin:controller.dbc", "a.dbc, b.dbc"), key("Pressures", "data_id = 4641")
    )
    whole = read_trace(load(machine / "run.toml"), machine / "run.blf").samples
    both = read_trace(load(project), machine / "run.blf").samples
    assert len(whole) > 1500 and np.array_equal(whole.values, both.values)
    names = f"{machine}/b.dbc,{machine}/a.dbc"
    code, out, err = said("check", "--bus-only", machine / "run.blf", "--dbc", names)
    assert code == 0, err
    assert "b.dbc: 1 of its 1 messages are here, 2000 frames." in out
    assert "a.dbc: 2 of its 4 messages are here, 4000 frames." in out
    code, out, _ = said(
        "check", "--bus-only", machine / "run.blf", "--dbc", machine / "b.dbc", "--json"
    )
    assert json.loads(out)["described"]["left"] == {"120": 2000, "122": 2000}
    names = f"{machine}/a.dbc,{CONTROLLER_DBC}"
    code, out, _ = said("check", "--bus-only", machine / "run.blf", "--dbc", names)
    assert "120 is ValveCommand-120 and ValveCommand-120-2: a project names which" in out


def test_one_identifier_on_two_channels_is_told_apart_by_the_project(machine: Path) -> None:
    frames = open_log(machine / "run.blf")
    frames.channel[frames.can_id == 289] = 1
    twin = frames[frames.can_id == 290]
    twin.channel[:] = 1
    twin.t_us[:] += 300
    twin.data[:] = 0
    mixed = fr.by_time(fr.concatenate([frames, twin]))
    blf.write(machine / "mixed.blf", mixed)
    code, out, _ = said("check", "--bus-only", machine / "mixed.blf")
    assert "122 comes on channels 0, 1: a project names one, channel = 0." in out
    code, _, err = said("check", machine / "run.toml", machine / "mixed.blf")
    assert code == 3
    assert "Motion comes on several channels: 0 (2000 frames), 1 (2000 frames)" in err
    assert "channel = 0 under [messages.Motion]" in err
    project = edited(machine, key("Motion", "channel = 0"))
    whole = read_trace(load(machine / "run.toml"), machine / "run.blf").samples
    apart = read_trace(load(project), machine / "mixed.blf").samples
    assert np.array_equal(whole.values, apart.values)
    code, out, _ = said("quick", machine / "mixed.blf", "--json")
    what = [a["what"] for a in json.loads(out)["assumptions"]]
    assert any("Motion comes on several channels, and channel 0 is meant" in w for w in what), what


def test_one_message_of_j1939_may_come_from_two_sensors(machine: Path) -> None:
    """p_a and p_b from two sensors of one type, which differ in their addresses alone."""
    (machine / "sensor.dbc").write_text(
        'VERSION ""\nBU_: S\n\nBO_ 2566894334 Sensor: 8 S\n'  # 0x98FFB2FE: PGN 0xFFB2 of anybody
        ' SG_ P : 0|16@1+ (200,0) [0|0] "Pa" S\n'
        '\nBA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\n'
    )
    frames = open_log(machine / "run.blf")
    pressures = frames[frames.can_id == 289]
    parts = [frames]
    for address, column, late_us in ((0x21, 16, 0), (0x22, 32, 40)):
        mine = pressures[:]
        mine = fr.concatenate([mine])  # a copy
        mine.can_id[:] = EXTENDED | 0x18FFB200 | address
        mine.t_us[:] += late_us
        counts = mine.data[:, column // 8] + 256.0 * mine.data[:, column // 8 + 1]
        raw = np.rint(counts * 152.59021896696422 / 200).astype("<u2")
        mine.data[:] = 0xFF
        mine.data[:, :2] = raw.view(np.uint8).reshape(-1, 2)
        parts.append(mine)
    blf.write(machine / "sensors.blf", fr.by_time(fr.concatenate(parts)))
    text = (machine / "run.toml").read_text()
    text = text.replace("builtin:controller.dbc", "builtin:controller.dbc, sensor.dbc")
    text = re.sub(r"(?m)^mode = .*", 'mode = "multirate"', text)
    for role, address in (("A", 0x21), ("B", 0x22)):
        old = f'message = "Pressures"\nsignal = "P{role}"'
        assert old in text
        text = text.replace(old, f'message = "P{role}"\nsignal = "P"')
        text += f'\n[messages.P{role}]\nof = "Sensor"\nperiod_ms = 1\naddress = {address}\n'
    (machine / "sensors.toml").write_text(text)
    trace = read_trace(load(machine / "sensors.toml"), machine / "sensors.blf")
    whole = read_trace(load(machine / "run.toml"), machine / "run.blf").samples
    for role in ("p_a", "p_b"):
        difference = np.median(trace.samples.column(role)) - np.median(whole.column(role))
        assert abs(difference) < 1e4 and len(trace.samples) > 1500
    assert abs(np.median(whole.column("p_a")) - np.median(whole.column("p_b"))) > 1e5
