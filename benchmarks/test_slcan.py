"""Frames from an slcan adapter: our bulk source beside python-can's, on the same bytes of a pty."""

from __future__ import annotations

import os
import tty
from collections.abc import Iterator
from typing import Any

import pytest
from can.interfaces.slcan import slcanBus

from benchmarks.frames import frames
from benchmarks.interleave import Job, ratio, side_by_side
from firmware_bridge.sources.slcan import Slcan
from firmware_bridge.sources.slcan_lines import Decoder

BURST = 150  # frames that a pty holds at once
BURSTS = 20
AT_LEAST = 50.0  # times python-can's speed


def bursts() -> list[bytes]:
    every = frames()[: BURST * BURSTS]
    text = [
        b"t%03X8%s\r" % (can_id, data.tobytes().hex().upper().encode())
        for can_id, data in zip(every.can_id.tolist(), every.data, strict=True)
    ]
    return [b"".join(text[k : k + BURST]) for k in range(0, len(text), BURST)]


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """The adapter's end of a pty, and the name of the port."""
    master, slave = os.openpty()
    for end in (master, slave):
        tty.setraw(end)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


def by_us(source: Slcan, master: int, burst: bytes) -> int:
    """Write a burst and read it back as frames; their number."""
    os.write(master, burst)
    pieces, size = [], 0
    while size < len(burst):
        piece = source._receive()
        assert piece is not None
        pieces.append(piece)
        size += len(piece[1])
    return len(source._convert(pieces))


def by_python_can(bus: slcanBus, master: int, burst: bytes) -> int:
    os.write(master, burst)
    return sum(bus.recv(1.0) is not None for _ in range(BURST))


def test_slcan(benchmark: Any, line: tuple[int, str]) -> None:
    (master, name), texts, decoder = line, bursts(), Decoder()
    whole = b"".join(texts)
    bus = slcanBus(name, sleep_after_open=0)
    source = Slcan(name)
    assert by_us(source, master, texts[0]) == by_python_can(bus, master, texts[0]) == BURST
    n = BURST * BURSTS
    jobs = [
        Job(
            "rtid, read in bulk from the port", lambda: [by_us(source, master, t) for t in texts], n
        ),
        Job("rtid, parsing alone", lambda: decoder.push(whole), n),
        Job("python-can", lambda: [by_python_can(bus, master, t) for t in texts], n),
    ]
    times = side_by_side(benchmark, "Frames from an slcan adapter", "frame", jobs, jobs[0].name, 9)
    source.stop()
    bus.shutdown()
    assert ratio(times, "python-can", jobs[0].name) >= AT_LEAST
