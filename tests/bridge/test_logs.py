from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.sources import LogError, blf, candump, open_log
from tests.bridge.machine import cycles, equal

START_S = 1_700_000_000.123


def traffic(n: int, seed: int, remote: bool = True) -> list[can.Message]:
    """Messages of all kinds: 11 and 29 bit, every length, remote and FD frames among them."""
    rng = np.random.default_rng(seed)
    messages = []
    for k in range(n):
        extended = bool(rng.integers(2))
        kind = rng.integers(20) if remote else 5
        size = 12 if kind == 1 else int(rng.integers(0, 9))
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
              ".csv": can.CSVWriter, ".trc": can.TRCWriter}[path.suffix]  # fmt: skip
    with writer(path) as log:
        for message in messages:
            log.on_message_received(message)
    return path


def oracle(path: Path) -> Frames:
    reader = can.BLFReader if path.suffix == ".blf" else can.CanutilsLogReader
    with reader(path) as log:
        return fr.from_messages(log)


@pytest.mark.parametrize("suffix", [".blf", ".log"])
@pytest.mark.parametrize("seed", [0, 1])
def test_own_readers_equal_those_of_python_can(tmp_path: Path, suffix: str, seed: int) -> None:
    path = write(tmp_path / f"t{suffix}", traffic(6000, seed))
    ours, theirs = open_log(path), oracle(path)
    assert equal(ours, theirs)
    assert ours.refused == theirs.refused
    assert 5000 < len(ours) < 6000
    assert ours.refused["remote_frame"] and ours.refused["fd_frame"]


def test_error_frames_are_counted(tmp_path: Path) -> None:
    messages = traffic(20, 2, remote=False)
    messages[5] = can.Message(timestamp=START_S + 5e-3, is_error_frame=True)
    ours = open_log(write(tmp_path / "t.blf", messages))
    assert len(ours) == 19
    assert ours.refused == {"error_frame": 1}


def test_short_fd_frames_are_kept(tmp_path: Path) -> None:
    messages = [can.Message(timestamp=START_S, arbitration_id=5, is_fd=True, data=b"\1\2\3")]
    for name in ("t.blf", "t.asc"):
        ours = open_log(write(tmp_path / name, messages))
        assert len(ours) == 1
        assert ours.data[0].tolist() == [1, 2, 3, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("write_own", [blf.write, candump.write])
def test_own_writers_round_trip(tmp_path: Path, write_own: Callable[[Path, Frames], None]) -> None:
    path = tmp_path / ("t.blf" if write_own is blf.write else "t.log")
    frames = cycles(3000)
    frames.can_id[::7] |= EXTENDED
    write_own(path, frames)
    assert equal(open_log(path), frames)
    assert equal(oracle(path), frames)


@pytest.mark.parametrize("suffix", [".asc", ".csv", ".trc"])
def test_other_formats_through_python_can(tmp_path: Path, suffix: str) -> None:
    messages = traffic(200, 3, remote=False)
    ours = open_log(write(tmp_path / f"t{suffix}", messages))
    wanted = fr.from_messages(messages)
    assert len(ours) == 200
    np.testing.assert_array_equal(ours.can_id, wanted.can_id)
    np.testing.assert_array_equal(ours.data, wanted.data)


def is_prefix(part: Frames, whole: Frames) -> bool:
    return equal(part, whole[: len(part)])


@pytest.mark.parametrize("suffix", [".blf", ".log"])
def test_cut_log_gives_a_prefix_and_says_truncated(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"t{suffix}", traffic(8000, 4, remote=False))
    whole, raw = open_log(path), path.read_bytes()
    rng = np.random.default_rng(5)
    cut = tmp_path / f"cut{suffix}"
    for size in rng.integers(400, len(raw) - 20, 60):
        cut.write_bytes(raw[:size])
        part = open_log(cut)
        assert is_prefix(part, whole)
        at_border = suffix == ".log" and raw[size - 1] == 10
        assert at_border or "truncated" in part.refused
        expected = len(whole) * (size - 300) / len(raw)
        if suffix == ".log":
            assert len(part) >= 0.995 * raw[:size].count(b"\n")
        else:
            assert len(part) >= 0.95 * expected - 300


@pytest.mark.parametrize("suffix", [".asc", ".csv", ".trc"])
def test_cut_text_log_never_gives_a_wrong_frame(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"t{suffix}", traffic(300, 9, remote=False))
    whole, raw = open_log(path), path.read_bytes()
    rng = np.random.default_rng(10)
    cut = tmp_path / f"cut{suffix}"
    for size in rng.integers(len(raw) // 10, len(raw) - 20, 40):
        cut.write_bytes(raw[:size])
        part = open_log(cut)
        assert is_prefix(part, whole)
        assert len(part) >= len(whole) * size / len(raw) * 0.9 - 25
        whole_line = raw[size - 1] in b"\r\n"  # TRC ends its lines with both: nothing is cut
        assert whole_line or "truncated" in part.refused


@pytest.mark.parametrize("suffix", [".blf", ".log"])
def test_flipped_bytes_lose_at_most_a_line_or_container(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"t{suffix}"
    (blf.write if suffix == ".blf" else candump.write)(path, cycles(7000))
    whole, raw = open_log(path), path.read_bytes()
    stamps = set(whole.t_us.tolist())
    rng = np.random.default_rng(6)
    bad = tmp_path / f"bad{suffix}"
    for place in rng.integers(160, len(raw), 60):
        broken = bytearray(raw)
        broken[place] ^= 1 << int(rng.integers(8))
        bad.write_bytes(broken)
        found = open_log(bad)
        lost = len(whole) - len(found)
        limit = 2 if suffix == ".log" else 2 * blf.WRITE_BYTES // 48
        assert lost <= limit
        if suffix == ".blf":
            assert set(found.t_us.tolist()) <= stamps
            assert lost == 0 or found.refused


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
    with pytest.raises(LogError, match=r"\.blf, \.log"):
        open_log(path)


def test_candump_variants(tmp_path: Path) -> None:
    path = tmp_path / "t.log"
    path.write_bytes(
        b"(1.5) vcan0 123#\r\n"
        b"\n"
        b"(1.500001) can12 00000123#00ff T\n"
        b"(2.25) slcan1 1FFFFFFF#DEADBEEF01020304 R\n"
        b"(3.0) can0 123#R8\n"
        b"(3.0) can0 123##0112233445566778899\n"
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
        "remote_frame": 1, "fd_frame": 1, "error_frame": 1, "bad_line": 2, "truncated": 1,
    }  # fmt: skip


def test_missing_asammdf_is_a_plain_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "asammdf", None)
    path = tmp_path / "t.mf4"
    path.write_bytes(b"MDF     4.10    ")
    with pytest.raises(LogError, match=r"rtid\[mf4\]"):
        open_log(path)


def test_real_capture(shared: Path) -> None:
    pytest.importorskip("asammdf", reason="needs the extra mf4")
    frames = open_log(shared / "data/can_j1939/vehicle.mf4")
    assert len(frames) == 150_411
    assert len(np.unique(frames.can_id)) == 67
    assert np.ptp(frames.t_us) * 1e-6 == pytest.approx(401.6, abs=0.1)
