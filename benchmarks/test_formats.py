"""Reading logs: rtid's bulk readers beside python-can's, and MF4 beside asammdf alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from benchmarks.interleave import Job, ratio, side_by_side
from firmware_bridge.frames import empty, to_messages
from firmware_bridge.sources import open_log

N = 20_000
LEAST = 1.5  # times python-can's speed
WRITERS: dict[str, Callable[[Path], Any]] = {
    ".blf": can.BLFWriter, ".log": can.CanutilsLogWriter, ".asc": can.ASCWriter,
    ".csv": can.CSVWriter, ".trc": can.TRCWriter, ".mf4": can.MF4Writer,
}  # fmt: skip


def write(path: Path, n: int, length: int) -> Path:
    rng = np.random.default_rng(0)
    frames = empty(n, length)
    frames.t_us[:] = 1_700_000_000_000_000 + 500 * np.arange(n)
    frames.can_id[:], frames.length[:] = rng.integers(0, 0x7FF, n), length
    frames.data[:] = rng.integers(0, 256, frames.data.shape)
    with WRITERS[path.suffix](path) as log:
        for message in to_messages(frames):
            log.on_message_received(message)
    return path


def by_python_can(path: Path) -> int:
    with can.LogReader(path) as log:
        return sum(1 for _ in log)


@pytest.mark.parametrize("length", [8, 64])
@pytest.mark.parametrize("suffix", list(WRITERS))
def test_reading(benchmark: Any, tmp_path: Path, suffix: str, length: int) -> None:
    if length > 8 and suffix in (".csv", ".trc"):
        pytest.skip("CAN FD is not among what this format holds")
    path = write(tmp_path / f"log{suffix}", N, length)
    assert len(open_log(path)) == by_python_can(path) == N
    jobs = [
        Job("rtid", lambda: open_log(path), N),
        Job("python-can", lambda: by_python_can(path), N),
    ]
    title = f"Reading {suffix} of frames of {length} bytes"
    times = side_by_side(benchmark, title, "frame", jobs, "rtid", rounds=3)
    assert ratio(times, "python-can", "rtid") >= LEAST
