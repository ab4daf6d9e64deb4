"""Cut and bit-flipped logs: what is lost, what is wrong, and that it is said (faults 15 and 16)."""

from __future__ import annotations

import re
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import can
import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler
from firmware_bridge.frames import Frames
from firmware_bridge.samples import Samples
from firmware_bridge.sources import open_log
from tests.bridge.machine import CATALOG, assembly, cycles, equal

N = 200  # cuts and flips per format
HANG_S = 10.0
CONTAINER = 16 << 10
OBJECT = 48  # bytes of a frame in a BLF container
SUFFIXES = (".asc", ".blf", ".log", ".csv", ".trc")

# Of the 200 flips of each format so many turn a digit into another one, which no grammar can see:
# the frame is wrong in its stamp, channel, identifier or payload.  BLF has zlib's checksum.
UNDETECTABLE = {".asc": 27, ".blf": 0, ".log": 47, ".csv": 46, ".trc": 31}


class SmallContainers(can.BLFWriter):
    max_container_size = CONTAINER


@dataclass(frozen=True)
class Log:
    """A whole log: its bytes, its frames, and where the line or container of each frame ends."""

    suffix: str
    raw: bytes
    frames: Frames
    ends: np.ndarray

    @property
    def head(self) -> int:
        """Size of the header."""
        starts = {
            ".asc": rb"0\.0+ Start", ".blf": rb"LOBJ", ".log": rb"\(", ".csv": rb"1",
            ".trc": rb"\n +0",
        }  # fmt: skip
        found = re.search(starts[self.suffix], self.raw)
        assert found
        return found.start()


@cache
def log(suffix: str, folder: Path) -> Log:
    """4500 frames as python-can writes them, without what differs from run to run."""
    writers = {
        ".asc": can.ASCWriter, ".blf": SmallContainers, ".log": can.CanutilsLogWriter,
        ".csv": can.CSVWriter, ".trc": can.TRCWriter,
    }  # fmt: skip
    path = folder / f"whole{suffix}"
    with writers[suffix](path) as writer:
        for message in fr.to_messages(cycles(1500)):
            writer.on_message_received(message)
    raw = path.read_bytes().replace(str(path).encode(), b"C:\\whole")
    raw = re.sub(rb"^date .*", b"date Tue Nov 14 22:13:20.500 2023", raw)
    path.write_bytes(raw)
    return Log(suffix, raw, open_log(path), np.array(list(_ends(suffix, raw))))


def _ends(suffix: str, raw: bytes) -> Iterator[int]:
    """Position behind the line or container that holds each frame's last byte."""
    if suffix != ".blf":
        frame = {".asc": b" d ", ".log": b"#", ".csv": b",0x", ".trc": b" DT "}[suffix]
        for line in re.finditer(rb".*\n", raw):
            if frame in line[0]:
                yield line.end()
        return
    size = n = 0
    for found in re.finditer(rb"LOBJ\x10\x00", raw):
        engine = zlib.decompressobj()
        size += len(engine.decompress(raw[found.start() + 32 :]))
        end = len(raw) - len(engine.unused_data)
        yield from [end] * (size // OBJECT - n)
        n = size // OBJECT


@pytest.fixture(params=SUFFIXES)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Log:
    return log(request.param, tmp_path_factory.getbasetemp())


def read(path: Path, raw: bytes) -> Frames:
    """Write and read a damaged log, which must end in time."""
    path.write_bytes(raw)
    start = time.perf_counter()
    found = open_log(path)
    assert time.perf_counter() - start < HANG_S
    return found


def wrong_frames(frames: Frames, whole: Frames, shift_us: int = 0) -> int:
    """How many frames are not among those of the whole log, stamps moved back by shift_us."""
    if len(frames) == len(whole):
        same = (frames.data == whole.data).all(axis=1) & (frames.t_us - shift_us == whole.t_us)
        for name in ("channel", "can_id", "length"):
            same &= getattr(frames, name) == getattr(whole, name)
        return int((~same).sum())
    return (rows(frames, shift_us) - rows(whole)).total()


def rows(frames: Frames, shift_us: int = 0) -> Counter[tuple[int, int, int, int, bytes]]:
    """The frames as countable things."""
    columns = (frames.t_us - shift_us, frames.channel, frames.can_id, frames.length)
    data = [row.tobytes() for row in frames.data]
    return Counter(zip(*(column.tolist() for column in columns), data, strict=True))


def flips(log: Log, places: np.ndarray, seed: int) -> Iterator[bytes]:
    rng = np.random.default_rng(seed)
    for place in places:
        broken = bytearray(log.raw)
        broken[place] ^= 1 << int(rng.integers(8))
        yield bytes(broken)


def most(log: Log) -> int:
    """Frames of the largest line or container; an object may straddle two containers."""
    return 1 if log.suffix != ".blf" else -(-CONTAINER // OBJECT) + 1


@pytest.mark.first_of(3)
def test_the_whole_log_is_read(whole: Log) -> None:
    frames = cycles(1500)
    assert whole.frames.refused == {}
    assert len(whole.ends) == len(whole.frames) == len(frames)
    assert np.array_equal(whole.frames.data, frames.data)
    shift_us = whole.frames.t_us - frames.t_us
    assert np.ptp(shift_us) == 0


def test_cut_anywhere_keeps_what_stands_before_and_says_truncated(
    whole: Log, tmp_path: Path
) -> None:
    rng = np.random.default_rng(15)
    shares = []
    for size in rng.integers(whole.head + 400, len(whole.raw) - 1, N):
        part = read(tmp_path / f"cut{whole.suffix}", whole.raw[:size])
        before = int((whole.ends <= size).sum())
        assert equal(part, whole.frames[: len(part)])  # 0 wrong frames
        shares.append(len(part) / max(before, 1))
        # what ends with a line and has no end mark is a whole log
        assert part.refused == {"truncated": 1} or (
            whole.raw[size - 1] == 10 and whole.suffix in (".log", ".csv", ".trc")
        )
    print(
        f"{whole.suffix}: {N} cuts, kept >= {100 * min(shares):.2f} % of the frames before, 0 wrong"
    )
    assert min(shares) >= 0.995


@pytest.mark.first_of(2)
def test_a_flipped_bit_costs_one_line_or_container(whole: Log, tmp_path: Path) -> None:
    """A digit that became another one passes as text; its CRC keeps it out of the samples."""
    rng = np.random.default_rng(16)
    expected = samples(whole.frames)
    seen = Counter[str]()
    worst = worst_samples = 0
    for raw in flips(whole, rng.integers(whole.head, len(whole.raw), N), 17):
        found = read(tmp_path / f"flip{whole.suffix}", raw)
        lost = len(whole.frames) - len(found)
        wrong = wrong_frames(found, whole.frames)
        assert 0 <= lost <= most(whole)
        assert wrong <= 1
        assert lost == 0 or sum(found.refused.values()) >= 1
        worst = max(worst, lost)
        if wrong:
            got = samples(found)
            worst_samples = max(worst_samples, len(expected) - len(got))
            seen += Counter(unseen=1) + judge(got, expected)
    print(
        f"{whole.suffix}: {N} flips, worst loss {worst} frames ({worst_samples} samples), "
        f"wrong frames: {dict(seen)}"
    )
    assert seen["unseen"] == UNDETECTABLE[whole.suffix]
    assert seen["wrong_value"] == 0


def samples(frames: Frames) -> Samples:
    return Assembler(CATALOG, assembly()).push(frames)


def judge(result: Samples, expected: Samples) -> Counter[str]:
    """How many samples hold values that never were, or good values at another time."""
    values = np.isin(as_bytes(result.values), as_bytes(expected.values))
    moved = values & ~np.isin(result.t_us, expected.t_us)
    return Counter(wrong_value=int((~values).sum()), moved_stamp=int(moved.sum()))


def as_bytes(values: np.ndarray) -> np.ndarray:
    """Rows as single things that can be compared."""
    return np.ascontiguousarray(values).view(f"V{values.itemsize * values.shape[1]}")[:, 0]


def test_a_flip_anywhere_in_the_header_costs_no_frame(whole: Log, tmp_path: Path) -> None:
    """The origin of time may move where a digit of the date became another one; nothing else.

    A candump log has no header.
    """
    places = np.arange(whole.head)[:: max(1, whole.head // N)]
    moved = 0
    for raw in flips(whole, places, 18):
        found = read(tmp_path / f"head{whole.suffix}", raw)
        assert len(found) == len(whole.frames)
        shift_us = int(found.t_us[-1] - whole.frames.t_us[-1])
        assert wrong_frames(found, whole.frames, shift_us) == 0
        moved += shift_us != 0
    print(f"{whole.suffix}: {len(places)} flips in the header, {moved} moved the origin of time")


@pytest.mark.parametrize("year", ["0", "10000", "4294967296", "1" + 40 * "0"])
def test_a_damaged_year_of_an_asc_costs_the_date_alone(tmp_path: Path, year: str) -> None:
    path = tmp_path / "year.asc"
    path.write_text(
        f"date Sun Sep 13 12:26:40.0 {year}\nbase hex  timestamps absolute\n"
        " 0.001000 1  120             Rx   d 8 EC A0 38 05 00 10 8D 02\n"
    )
    assert len(open_log(path)) == 1
