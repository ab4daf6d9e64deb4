from __future__ import annotations

import os
import re
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources import LogError, mf4, mf4_child, open_log, read_table
from tests.bridge.machine import cycles, equal

N = 50
LOOP = "    try:\n        while True:\n            pass\n        columns"
HEAD = 48  # bytes of the head of a compressed block


def measurement(path: Path) -> Path:
    """A plain measurement: two channels of numbers."""
    from asammdf import MDF, Signal

    stamps = 0.01 * np.arange(100)
    with MDF(version="4.10") as log:
        log.append([Signal(np.sin(stamps + k), stamps, "bar", f"p{k}") for k in range(2)])
        log.save(path)
    return path


def test_missing_asammdf_is_a_plain_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = measurement(tmp_path / "t.mf4")
    assert set(read_table(path).columns) >= {"p0", "p1"}
    bus = write(tmp_path / "bus.mf4", cycles(10))
    monkeypatch.setattr(sys, "path", [])
    with pytest.raises(LogError, match=r"rtid\[mf4\]"):
        read_table(path)
    assert len(open_log(bus)) == 30


def write(path: Path, frames: Frames) -> Path:
    with can.MF4Writer(path, compression_level=0) as log:
        for message in fr.to_messages(frames):
            log.on_message_received(message)
    return path


def compress(path: Path) -> Path:
    """The same log in compressed blocks of 16 KiB, each with a checksum."""
    from asammdf import MDF

    with MDF(path) as log:
        log.configure(write_fragment_size=16 << 10)
        log.save(path.with_stem("packed"), compression=2)
    return path.with_stem("packed")


def rows(frames: Frames) -> Counter[tuple[int, int, int, bytes]]:
    data = [row.tobytes() for row in frames.data]
    columns = (frames.t_us.tolist(), frames.can_id.tolist(), frames.length.tolist())
    return Counter(zip(*columns, data, strict=True))


def each(path: Path, contents: Iterator[bytes]) -> Iterator[Frames | str]:
    """What is read of each content, or the error."""
    for content in contents:
        path.write_bytes(content)
        try:
            yield open_log(path)
        except LogError as error:
            yield str(error)


def flips(raw: bytes, inside: Callable[[int], bool], seed: int) -> Iterator[bytes]:
    rng = np.random.default_rng(seed)
    places = [k for k in rng.integers(64, len(raw), 20 * N).tolist() if inside(k)][:N]
    for place in places:
        broken = bytearray(raw)
        broken[place] ^= 1 << int(rng.integers(8))
        yield bytes(broken)


def test_what_python_can_writes_is_read(tmp_path: Path) -> None:
    frames = cycles(200)
    frames.can_id[::7] |= fr.EXTENDED
    found = open_log(write(tmp_path / "t.mf4", frames))
    assert np.ptp(found.t_us - frames.t_us) <= 1  # the format has seconds as floats
    found.t_us[:] = frames.t_us
    assert equal(found, frames)
    assert found.refused == {}


def test_real_capture(shared: Path) -> None:
    frames = open_log(shared / "data/can_j1939/vehicle.mf4")
    assert len(frames) == 150_411
    assert len(np.unique(frames.can_id)) == 67
    assert np.ptp(frames.t_us) * 1e-6 == pytest.approx(401.6, abs=0.1)
    assert frames.refused == {"not_finalised": 1}


def test_cut_real_capture_keeps_what_stands_before(shared: Path, tmp_path: Path) -> None:
    """The logger writes the index first; records of 19 to 20 bytes follow from `first` on."""
    path = shared / "data/can_j1939/vehicle.mf4"
    raw, first = path.read_bytes()[:400_000], 106_800
    path = tmp_path / "t.mf4"
    path.write_bytes(raw)
    whole = open_log(path)
    good, size = rows(whole), (len(raw) - first) / len(whole)
    cuts = np.random.default_rng(15).integers(first + 20_000, len(raw), N).tolist()
    shares = []
    for cut, part in zip(cuts, each(path, (raw[:k] for k in cuts)), strict=True):
        assert isinstance(part, Frames)
        assert not rows(part) - good
        assert part.refused == {"not_finalised": 1}
        shares.append(len(part) / ((cut - first) / size))
    print(f".mf4, index first: {N} cuts, kept >= {100 * min(shares):.1f} %, 0 wrong")
    assert min(shares) >= 0.995
    place = raw.rfind(b"##DT")  # a size that the logger wrote some time before it was cut
    path.write_bytes(raw[: place + 8] + struct.pack("<Q", 5000) + raw[place + 16 :])
    assert rows(open_log(path)) == good
    path.write_bytes(raw[: first - 5000])
    with pytest.raises(LogError, match="truncated"):
        open_log(path)


def test_cut_log_without_its_index_is_refused_as_truncated(tmp_path: Path) -> None:
    raw = write(tmp_path / "t.mf4", cycles(500)).read_bytes()
    cut = tmp_path / "cut.mf4"
    for size in np.random.default_rng(15).integers(64, len(raw) - 30_000, N).tolist():
        cut.write_bytes(raw[:size])
        with pytest.raises(LogError, match="truncated"):
            open_log(cut)


def test_a_flipped_bit_costs_one_block(tmp_path: Path) -> None:
    """What is in compressed blocks has a checksum; their heads and the index have none."""
    packed = compress(write(tmp_path / "t.mf4", cycles(1500)))
    raw, whole = packed.read_bytes(), open_log(packed)
    heads = [k.start() for k in re.finditer(b"##DZ", raw)]
    inner = {k for a, b in pairwise(heads) for k in range(a + HEAD, b)}
    good, lost = rows(whole), []
    for found in each(tmp_path / "flip.mf4", flips(raw, inner.__contains__, 16)):
        assert isinstance(found, Frames)
        assert not rows(found) - good
        lost.append(len(whole) - len(found))
        assert lost[-1] == 0 or found.refused["bad_container"] == 1
    print(f".mf4: {N} flips in blocks, worst loss {max(lost)} frames of one block, 0 wrong")
    assert 0 < max(lost) <= (16 << 10) // 84 + 2


def test_a_flipped_bit_in_the_index_is_an_error_or_a_count(tmp_path: Path) -> None:
    """No such file hangs or ends in anything else; frames are missing only with a word."""
    raw = write(tmp_path / "t.mf4", cycles(300)).read_bytes()
    data, seen, path = raw.rfind(b"##DT"), Counter[str](), tmp_path / "flip.mf4"
    index = data + int.from_bytes(raw[data + 8 : data + 16], "little")  # stamps may hold a "##"
    for result in each(path, flips(raw, lambda k: k >= index, 17)):
        if isinstance(result, str):
            seen["refused"] += 1
            assert str(path) in result
        else:
            seen["read"] += 1
            assert len(result) == 900 or result.refused
    print(f".mf4: {seen.total()} flips in the index: {dict(seen)}")
    assert seen["read"] > 10 and seen["refused"] > 3


def test_a_crash_of_asammdf_is_an_error_of_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = measurement(tmp_path / "t.mf4")
    child = tmp_path / "child.py"
    monkeypatch.setattr(mf4_child, "__file__", str(child))
    child.write_text("import os; os.abort()")
    with pytest.raises(LogError, match="crashed"):
        read_table(path)


def test_processor_time_ends_a_read_and_waiting_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child that gets no processor for longer than its limit reads its whole log all the same."""
    path, started = measurement(tmp_path / "t.mf4"), subprocess.run
    before = os.times()
    read_table(path)
    limit_s = 2.0 + 2.0 * (os.times().children_user - before.children_user)  # enough for it here

    def held_up(arguments: list[str], **options: Any) -> subprocess.CompletedProcess[bytes]:
        wait = (
            f"import os, sys, time; time.sleep({limit_s + 1}); os.execv(sys.argv[1], sys.argv[1:])"
        )
        return started([sys.executable, "-c", wait, *arguments], **options)

    monkeypatch.setattr(mf4, "CPU_S", limit_s)
    monkeypatch.setattr(subprocess, "run", held_up)
    assert len(read_table(path).column("p0")) == 100
    monkeypatch.setattr(subprocess, "run", started)
    monkeypatch.setattr(mf4, "CPU_S", 1.0)
    endless = Path(mf4_child.__file__).read_text().replace("    try:\n        columns", LOOP)
    child = tmp_path / "child.py"
    child.write_text(endless)
    monkeypatch.setattr(mf4_child, "__file__", str(child))
    with pytest.raises(LogError, match="not read in 1 s of processor time"):
        read_table(path)
