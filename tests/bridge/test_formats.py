"""Formats that people's loggers write: candump as it is shown, CAN FD, plain MF4, bags of ROS."""

from __future__ import annotations

import datetime
import gzip
import json
import random
from pathlib import Path

import can
import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.sources import LogError, blf, candump, open_file, open_log, read_table
from firmware_bridge.sources.can_bus import CanBus
from tests.bridge.machine import cycles, equal
from tests.command import ends
from tests.fuzz import mutate
from tests.fuzz.seeds import write_mcap

MUTATED = 60  # 500 of each were tried
FD_LENGTHS = (0, 7, 8, 12, 16, 20, 24, 32, 48, 64)


def long_messages(n: int = 400) -> list[can.Message]:
    rng = np.random.default_rng(4)
    return [
        can.Message(
            timestamp=1_700_000_000.0 + 1e-3 * k, arbitration_id=0x100 + k % 7 + 0x10000 * (k % 2),
            is_extended_id=bool(k % 2), is_fd=True, channel=k % 2, bitrate_switch=bool(k % 3),
            data=rng.integers(0, 256, FD_LENGTHS[k % len(FD_LENGTHS)], np.uint8).tobytes(),
        )
        for k in range(n)
    ]  # fmt: skip


@pytest.mark.parametrize("suffix", [".blf", ".log", ".asc", ".mf4"])
def test_frames_of_can_fd_are_read_to_64_bytes(tmp_path: Path, suffix: str) -> None:
    writer = {".blf": can.BLFWriter, ".log": can.CanutilsLogWriter, ".asc": can.ASCWriter,
              ".mf4": can.MF4Writer}[suffix]  # fmt: skip
    path, messages = tmp_path / f"t{suffix}", long_messages()
    with writer(path) as log:
        for message in messages:
            log.on_message_received(message)
    sent, read = fr.from_messages(messages), open_log(path)
    assert read.data.shape == (400, 64) and not read.refused.get("fd_frame")
    assert np.array_equal(read.data, sent.data) and np.array_equal(read.can_id, sent.can_id)
    assert np.array_equal(read.length, sent.length)
    for write in (blf.write, candump.write):
        again = tmp_path / f"again{'.blf' if write is blf.write else '.log'}"
        write(again, sent)
        assert equal(open_log(again), sent)


def test_frames_of_a_live_bus_of_can_fd_are_read() -> None:
    with (
        CanBus("virtual", "rtid-fd", fd=True) as source,
        can.Bus(interface="virtual", channel="rtid-fd", fd=True) as sender,
    ):
        for message in [*long_messages(40), can.Message(is_error_frame=True)]:
            sender.send(message)
        got: list[Frames] = []
        while sum(map(len, got)) < 40:
            got.append(source.read())
        got.append(source.read())
    frames = fr.concatenate(got)
    assert sorted(set(frames.length.tolist())) == list(FD_LENGTHS)
    assert frames.refused == {"error_frame": 1}


SHOWN = """\
 ({0})  can0  123   [8]  11 22 33 44 55 66 77 88   '."3DUfw.'
 ({1})  vcan1  1234ABCD   [2]  AA BB
 ({2})  can0  123   [0]
 ({3})  can0  123   [4]  remote request
 ({4})  can0  321  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B
 ({5})  can0  123   [2]  11
"""
ZERO = [f"{t:010.6f}" for t in (0.0, 0.5, 0.50001, 1.0, 2.0, 3.0)]
STAMPS = {
    "a": [f"{1_600_000_000 + float(t):.6f}" for t in ZERO],
    "z": ZERO,
    "d": ["000.000000", "000.500000", "000.000010", "000.499990", "001.000000", "001.000000"],
    "A": [f"2020-09-13 12:26:{40 + float(t):09.6f}" for t in ZERO],
}


@pytest.mark.parametrize("style", [*STAMPS, "numbered", "x"])
def test_candump_as_it_shows_frames(tmp_path: Path, style: str) -> None:
    path, lines = tmp_path / "t.log", SHOWN.format(*STAMPS.get(style, ZERO)).splitlines()
    if style == "numbered":
        lines = [f"  {k + 1}  {line}" for k, line in enumerate(lines)]
    if style == "x":
        lines = [line.replace("can0  ", "can0  TX - -  ") for line in lines]
    path.write_text("\n".join(lines) + "\n")
    frames = open_log(path)
    start = {"a": 1_600_000_000.0, "A": datetime.datetime(2020, 9, 13, 12, 26, 40).timestamp()}
    start_us = round(1e6 * start.get(style, 0.0))
    assert (frames.t_us - start_us).tolist()[:3] == [0, 500_000, 500_010]
    assert frames.can_id.tolist() == [0x123, 0x1234ABCD | EXTENDED, 0x123, 0x321]
    assert frames.length.tolist() == [8, 2, 0, 12] and frames.channel.tolist() == [0, 1, 0, 0]
    assert frames.data[3, :12].tolist() == list(range(12))
    assert frames.refused == {"remote_frame": 1, "bad_line": 1}


def test_a_plain_measurement_of_mf4_is_a_table(tmp_path: Path) -> None:
    from asammdf import MDF, Signal

    t, slow = np.arange(200) * 1e-3, np.arange(20) * 1e-2
    with MDF() as mdf:
        mdf.append([Signal(samples=np.sin(t), timestamps=t, name="p_a", unit="bar"),
                    Signal(samples=np.arange(200), timestamps=t, name="u")])  # fmt: skip
        mdf.append(Signal(samples=10 * slow, timestamps=slow, name="x", unit="mm"))
        mdf.save(tmp_path / "t.mf4")
    table = read_table(tmp_path / "t.mf4")
    assert table.units == {"t": "s", "p_a": "bar", "u": "", "x": "mm"}
    assert np.allclose(table.columns["p_a"], np.sin(t))
    known = t <= slow[-1]
    assert np.allclose(table.columns["x"][known], 10 * t[known])
    assert np.isnan(table.columns["x"][~known]).all()
    with pytest.raises(LogError, match="a table of samples is no log"):
        open_log(tmp_path / "t.mf4")


def test_a_bag_of_ros_is_a_table_of_topics_and_fields(tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    number, vector = store.types["std_msgs/msg/Float64"], store.types["geometry_msgs/msg/Vector3"]
    for plugin, name in ((StoragePlugin.MCAP, "bag.mcap"), (StoragePlugin.SQLITE3, "bag.db3")):
        folder = tmp_path / name / "bag"
        folder.parent.mkdir()
        with Writer(folder, version=9, storage_plugin=plugin) as bag:
            fast = bag.add_connection("/arm/p_a", number.__msgtype__, typestore=store)
            slow = bag.add_connection("/force", vector.__msgtype__, typestore=store)
            for k in range(101):
                stamp = 10**18 + k * 10**7
                bag.write(fast, stamp, store.serialize_cdr(number(float(k)), number.__msgtype__))
                if k % 4 == 0:
                    raw = store.serialize_cdr(vector(2.0 * k, 1.0, 0.0), vector.__msgtype__)
                    bag.write(slow, stamp, raw)
        table = read_table(folder / name)
        assert list(table.columns) == ["t", "arm.p_a.data", "force.x", "force.y", "force.z"]
        assert np.allclose(table.columns["t"], 0.01 * np.arange(101))
        assert np.allclose(table.columns["force.x"], 2.0 * np.arange(101))


def test_mcap_in_json_is_a_table_and_what_is_damaged_is_one_line(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "t.mcap"
    with path.open("wb") as file:
        log = Writer(file)
        log.start()
        schema = log.register_schema("press", "jsonschema", b'{"type": "object"}')
        channel = log.register_channel("/press", "json", schema)
        for k in range(50):
            data = json.dumps({"p": [k, 2 * k], "ok": True, "name": "a"}).encode()
            log.add_message(channel, k * 10**7, data, k * 10**7)
        log.finish()
    table = read_table(path)
    assert list(table.columns) == ["t", "press.p.0", "press.p.1", "press.ok"]
    assert table.columns["press.p.1"].tolist() == list(range(0, 100, 2))
    raw = path.read_bytes()
    for k in range(8, len(raw), 97):
        path.write_bytes(raw[:k])
        with pytest.raises(LogError, match=r"t\.mcap"):
            read_table(path)


def as_savvy(frames: Frames) -> str:
    head = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
    rows = zip(frames.t_us, frames.can_id, frames.length, frames.data, strict=True)
    lines = (f"{t},{i:08X},false,Rx,0,{n},{bytes(d[:n]).hex(',')},\n" for t, i, n, d in rows)
    return head + "".join(lines)


def as_shown(frames: Frames) -> str:
    rows = zip(frames.t_us, frames.can_id, frames.length, frames.data, strict=True)
    return "".join(
        f" ({t * 1e-6:.6f})  can0  {i:03X}   [{n}]  {bytes(d[:n]).hex(' ').upper()}\n"
        for t, i, n, d in rows
    )


@pytest.mark.parametrize(
    "name", ["savvy.csv", "shown.log", "fd.log", "fd.asc", "fd.blf", "t.log.gz", "t.mcap"]
)
def test_mutated_files_are_read_or_refused_in_one_line_and_no_line_is_lost(
    tmp_path: Path, name: str
) -> None:
    path, frames = tmp_path / name, cycles(40)
    if name == "t.mcap":
        t = np.arange(50) * 0.01
        write_mcap(path, {"t": t, "p_a": np.sin(t), "u": t})
    elif name.startswith("fd"):
        with can.Logger(path) as log:
            for message in long_messages(100):
                log.on_message_received(message)
    elif name == "t.log.gz":
        candump.write(tmp_path / "t.log", frames)
        path.write_bytes(gzip.compress((tmp_path / "t.log").read_bytes(), mtime=0))
    else:
        path.write_text(as_savvy(frames) if name == "savvy.csv" else as_shown(frames))
    raw, rng = path.read_bytes(), random.Random(name)
    is_text = name in ("savvy.csv", "shown.log", "fd.log")
    read = 0
    for _ in range(MUTATED):
        content = (mutate.of_text if is_text else mutate.of_bytes)(raw, rng)
        path.write_bytes(content)
        try:
            got = open_file(path)
        except LogError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            continue
        read += 1
        if is_text and isinstance(got, Frames):
            lines = sum(bool(line.strip()) for line in content.split(b"\n"))
            assert len(got) + sum(got.refused.values()) >= lines - (name == "savvy.csv")
    assert read > 5


def test_bursts_repeats_and_stamps_that_go_back_are_told_with_their_effect(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [
        f"({k // 40 * 0.02 + 1:.6f}) can0 {k % 40 + 256:03X}#{k % 256:02X}\n" for k in range(400)
    ]
    lines[39] = lines[38]
    lines.append("(1.150000) can1 100#00\n(1.100000) can1 101#00\n")
    path = tmp_path / "t.log"
    path.write_text("".join(lines))
    for words, wanted in ((["--json"], '"stamps": {"backward": 1, "repeated": 1, "in_bursts": 400'),
                          ([], "20 ms of silence")):  # fmt: skip
        assert ends("check", "--bus-only", path, *words) == 0
        assert wanted in " ".join(capsys.readouterr().out.split())
