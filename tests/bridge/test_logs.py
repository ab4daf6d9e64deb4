from __future__ import annotations

import gzip
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.sources import LogError, blf, candump, open_log, read_table
from tests.bridge.machine import cycles, equal

START_S = 1_700_000_000.123


def traffic(n: int, seed: int, remote: bool = True) -> list[can.Message]:
    """Messages of all kinds: 11 and 29 bit, every length, remote and FD frames among them."""
    rng = np.random.default_rng(seed)
    messages = []
    for k in range(n):
        extended = bool(rng.integers(2))
        kind = rng.integers(20) if remote else 5
        size = (12, 64)[k % 2] if kind == 1 else int(rng.integers(0, 9))
        messages.append(
            can.Message(
                timestamp=START_S + 1e-3 * k + 1e-6 * int(rng.integers(0, 900)),
                arbitration_id=int(rng.integers(0, 1 << (29 if extended else 11))),
                is_extended_id=extended,
                is_remote_frame=kind == 0,
                is_fd=kind == 1,
                channel=int(rng.integers(0, 3)),
                dlc=size,
                data=None if kind == 0 else bytes(rng.integers(0, 256, size, np.uint8)),
                is_rx=bool(rng.integers(2)),
            )
        )
    return messages


def write(path: Path, messages: list[can.Message]) -> Path:
    writer = {".blf": can.BLFWriter, ".log": can.CanutilsLogWriter, ".asc": can.ASCWriter,
              ".csv": can.CSVWriter, ".trc": can.TRCWriter,
              ".mf4": can.MF4Writer}[path.suffix]  # fmt: skip
    with writer(path) as log:
        for message in messages:
            log.on_message_received(message)
    return path


def oracle(path: Path) -> Frames:
    """What python-can reads; its TRC reader leaves buses as they are numbered, from 1."""
    readers: dict[str, Callable[[Path], Any]] = {
        ".blf": can.BLFReader, ".log": can.CanutilsLogReader, ".csv": can.CSVReader,
        ".asc": partial(can.ASCReader, relative_timestamp=False), ".trc": can.TRCReader,
    }  # fmt: skip
    with readers[path.suffix](path) as log:
        found = fr.from_messages(log)
    found.channel[:] -= path.suffix == ".trc"
    return found


@pytest.mark.parametrize("suffix", [".blf", ".log", ".asc", ".csv", ".trc"])
@pytest.mark.parametrize("seed", [0, 1])
def test_own_readers_equal_those_of_python_can(tmp_path: Path, suffix: str, seed: int) -> None:
    messages = traffic(6000, seed)
    path = write(tmp_path / f"t{suffix}", messages)
    ours, theirs, sent = open_log(path), oracle(path), fr.from_messages(messages)
    assert equal(ours, theirs)
    assert ours.refused == theirs.refused
    assert 5000 < len(ours) < 6000
    if suffix != ".trc":  # its writer leaves them out
        assert np.array_equal(ours.data, sent.data)
        assert ours.refused["remote_frame"] and ours.length.max() == 64
    if suffix not in (".csv", ".trc"):  # has no channels
        assert np.array_equal(ours.channel, sent.channel)


def test_error_frames_are_counted(tmp_path: Path) -> None:
    messages = traffic(20, 2, remote=False)
    messages[5] = can.Message(timestamp=START_S + 5e-3, is_error_frame=True)
    ours = open_log(write(tmp_path / "t.blf", messages))
    assert len(ours) == 19
    assert ours.refused == {"error_frame": 1}


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log", ".mf4"])
def test_short_fd_frames_are_read_beside_classic_ones(tmp_path: Path, suffix: str) -> None:
    sent = partial(can.Message, timestamp=START_S, arbitration_id=5, data=b"\1\2\3")
    messages = [sent(is_fd=True), sent(is_fd=True, bitrate_switch=True), sent()]
    ours = open_log(write(tmp_path / f"t{suffix}", messages))
    assert ours.length.tolist() == [3, 3, 3] and ours.data.shape == (3, 8)
    assert ours.refused == {}


def test_a_classic_frame_in_an_fd_object_of_a_blf_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Channels that are configured for CAN FD log all their frames in such objects."""
    message = can.Message(timestamp=START_S, arbitration_id=5, is_fd=True, data=b"\1\2\3")
    monkeypatch.setattr("can.io.blf.EDL", 0)
    ours = open_log(write(tmp_path / "t.blf", [message]))
    assert ours.data.tolist() == [[1, 2, 3, 0, 0, 0, 0, 0]]
    assert ours.refused == {}


@pytest.mark.parametrize("write_own", [blf.write, candump.write])
def test_own_writers_round_trip(tmp_path: Path, write_own: Callable[[Path, Frames], None]) -> None:
    path = tmp_path / ("t.blf" if write_own is blf.write else "t.log")
    frames = cycles(3000)
    frames.can_id[::7] |= EXTENDED
    write_own(path, frames)
    assert equal(open_log(path), frames)
    assert equal(oracle(path), frames)


@pytest.mark.parametrize("suffix", [".blf", ".log", ".asc", ".trc", ".csv"])
def test_garbage_is_refused_with_the_file_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"g{suffix}"
    with pytest.raises(LogError, match="no such file"):
        open_log(path)
    path.write_bytes(b"")
    with pytest.raises(LogError, match="empty"):
        open_log(path)
    path.write_bytes(np.random.default_rng(7).integers(0, 256, 3000, np.uint8).tobytes())
    try:
        assert len(open_log(path)) == 0
    except LogError as error:
        assert str(path) in str(error)


def test_random_bytes_behind_a_blf_header_never_hang(tmp_path: Path) -> None:
    path = tmp_path / "t.blf"
    blf.write(path, cycles(10))
    head = path.read_bytes()[: blf.HEADER_BYTES]
    rng = np.random.default_rng(8)
    for k in range(20):
        body = rng.integers(0, 256, 5000, np.uint8)
        for place in rng.integers(0, 4900, 10):
            body[place : place + 4] = np.frombuffer(b"LOBJ", np.uint8)
            if k % 2:
                body[place + 12 : place + 16] = [10, 0, 0, 0]
        path.write_bytes(head + body.tobytes())
        assert len(open_log(path)) == 0 or k % 2


def test_unknown_suffix_names_the_known_ones(tmp_path: Path) -> None:
    path = tmp_path / "t.xyz"
    path.write_text("x")
    with pytest.raises(LogError, match=r"\.blf, \.mf4, \.log"):
        open_log(path)


def test_the_content_says_what_a_file_is_before_its_suffix(tmp_path: Path) -> None:
    messages = traffic(20, 1)
    for suffix in (".blf", ".log", ".asc", ".csv", ".trc"):
        log = write(tmp_path / f"t{suffix}", messages)
        for wrong in (".mf4", ".txt", ".xyz", ""):
            path = tmp_path / f"wrong{wrong}"
            path.write_bytes(log.read_bytes())
            assert equal(open_log(path), open_log(log))
            with pytest.raises(LogError, match="a log of frames is no table"):
                read_table(path)
    with pytest.raises(LogError, match="a folder"):
        open_log(tmp_path)
    table = tmp_path / "table.csv"
    table.write_text("t,p_a\n0.0,1e5\n0.1,1e5\n")
    with pytest.raises(LogError, match="a table of samples is no log of frames"):
        open_log(table)


def test_gzip_is_unpacked_for_every_format_and_its_damage_counted(tmp_path: Path) -> None:
    for suffix in (".blf", ".log", ".asc", ".csv", ".trc"):
        log = write(tmp_path / f"t{suffix}", traffic(3000, 1))
        whole, packed = open_log(log), tmp_path / f"t{suffix}.gz"
        content = gzip.compress(log.read_bytes(), mtime=0)
        packed.write_bytes(content)
        assert equal(open_log(packed), whole)
        packed.write_bytes(content[: len(content) // 2])
        cut = open_log(packed)
        assert 0 < len(cut) < len(whole) and cut.refused["truncated"]
        packed.write_bytes(content[:-8] + b"\0\0\0\0" + content[-4:])
        wrong = open_log(packed)
        assert equal(wrong, whole) and wrong.refused["bad_container"] == 1
    table = tmp_path / "table.csv.gz"
    table.write_bytes(gzip.compress(b"t,p_a\n0.0,1e5\n0.1,1e5\n"))
    assert read_table(table).path == table
    table.write_bytes(table.read_bytes()[:-8] + bytes(8))
    with pytest.raises(LogError, match="cut or damaged"):
        read_table(table)


def test_candump_variants(tmp_path: Path) -> None:
    path = tmp_path / "t.log"
    path.write_bytes(
        b"(1.5) vcan0 123#\r\n"
        b"\n"
        b"(1.500001) can12 00000123#00ff T\n"
        b"(2.25) slcan1 1FFFFFFF#DEADBEEF01020304 R\n"
        b"(3.0) can0 123#R8\n"
        b"(3.0) can0 123##0112233445566778899\n"  # nine bytes
        b"(4.0) can0 20000080#0000000000000000\n"
        b"(5.0) can0 12#00\n"
        b"(5.0) can0 123#001\n"
        b"(6.0) can0 123#00"
    )
    frames = open_log(path)
    assert frames.t_us.tolist() == [1_500_000, 1_500_001, 2_250_000]
    assert frames.channel.tolist() == [0, 12, 1]
    assert frames.can_id.tolist() == [0x123, 0x123 | EXTENDED, 0x1FFFFFFF | EXTENDED]
    assert frames.length.tolist() == [0, 2, 8]
    assert frames.refused == {
        "remote_frame": 1, "error_frame": 1, "bad_line": 3, "truncated": 1,
    }  # fmt: skip
