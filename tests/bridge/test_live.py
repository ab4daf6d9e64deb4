from __future__ import annotations

import contextlib
import os
import threading
import time
import tty
from collections.abc import Iterator
from random import Random

import can
import numpy as np
import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.sources import serial_port
from firmware_bridge.sources.can_bus import CanBus
from firmware_bridge.sources.live import SourceError
from firmware_bridge.sources.serial_port import Decoder, SerialPort
from tests.bridge.machine import CATALOG, assembly, cycles, equal


def collect(source: CanBus | SerialPort, n: int, limit_s: float = 10.0) -> Frames:
    parts, count, end = [], 0, time.monotonic() + limit_s
    while count < n and time.monotonic() < end:
        parts.append(source.read())
        count += len(parts[-1])
    return fr.concatenate(parts)


def test_virtual_bus_delivers_the_same_samples_as_replay() -> None:
    frames = cycles(200)
    sender = can.Bus(interface="virtual", channel="bridge", preserve_timestamps=True)
    with CanBus("virtual", "bridge") as source:
        for message in fr.to_messages(frames):
            sender.send(message, timeout=1.0)
        got = collect(source, len(frames))
    sender.shutdown()
    assert len(got) == len(frames)
    got.channel[:] = frames.channel  # the virtual bus names the channel, not its number
    assert equal(got, frames)
    live = Assembler(CATALOG, assembly()).push(got)
    replayed = Assembler(CATALOG, assembly()).push(frames)
    assert live.values.tobytes() == replayed.values.tobytes()


def test_filter_keeps_foreign_frames_out() -> None:
    sender = can.Bus(interface="virtual", channel="filter")
    with CanBus("virtual", "filter", can_ids=[0x120, 0x120 | EXTENDED]) as source:
        for can_id, extended in ((0x120, False), (0x121, False), (0x120, True), (0x7FF, True)):
            sender.send(can.Message(arbitration_id=can_id, is_extended_id=extended), timeout=1.0)
        got = collect(source, 2)
        assert len(source.read(0.05)) == 0
    sender.shutdown()
    assert got.can_id.tolist() == [0x120, 0x120 | EXTENDED]


def test_receive_error_reaches_the_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    source = CanBus("virtual", "broken")
    calls: Iterator[can.Message | Exception] = iter(
        [can.Message(arbitration_id=1), can.CanOperationError("adapter gone")]
    )

    def recv(_timeout: float) -> can.Message:
        item = next(calls)
        if isinstance(item, Exception):
            raise item
        return item

    monkeypatch.setattr(source._bus, "recv", recv)
    with source, pytest.raises(SourceError, match="adapter gone"):
        count = sum(len(batch) for batch in source)
        pytest.fail(f"{count} frames and no error")
    source.stop()  # twice is harmless


def test_full_queue_drops_the_oldest_and_says_so() -> None:
    source = CanBus("virtual", "full")
    source._queue_items = 10
    for k in range(25):
        source._put(can.Message(arbitration_id=k, is_extended_id=False))
    got = source.read()
    source.stop()
    assert got.can_id.tolist() == list(range(15, 25))
    assert got.refused == {"overrun": 15}


def test_iteration_ends_at_stop() -> None:
    source = CanBus("virtual", "ends").start()
    threading.Timer(0.1, source.stop).start()
    assert list(source) == []


def test_unknown_interface_and_port_are_plain_errors() -> None:
    with pytest.raises(SourceError, match="cannot open nonsense"):
        CanBus("nonsense", "x")
    with pytest.raises(SourceError, match="cannot open serial port"):
        SerialPort("/dev/no_such_port")


@given(
    st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=30), st.randoms(use_true_random=False)
)
@settings(max_examples=40, deadline=None)
def test_serial_stream_cut_anywhere(ids: list[int], random: Random) -> None:
    frames = fr.empty(len(ids))
    frames.can_id[:] = ids
    rng = np.random.default_rng(len(ids))
    frames.t_us[:] = rng.integers(0, 2**53, len(ids))
    frames.length[:] = rng.integers(0, 9, len(ids))
    raw = rng.integers(0, 3, (len(ids), 8), np.uint8)
    frames.data[:] = np.where(np.arange(8) < frames.length[:, None], raw, 0)
    stream, decoder, parts = serial_port.encode(frames), Decoder(), []
    while stream:
        size = random.randint(1, 40)
        parts.append(decoder.push(stream[:size]))
        stream = stream[size:]
    assert equal(fr.concatenate(parts), frames)


def contents(frames: Frames) -> set[tuple[int, int, bytes]]:
    columns = (frames.t_us, frames.can_id, frames.data)
    return {(int(t), int(i), d.tobytes()) for t, i, d in zip(*columns, strict=True)}


def test_serial_survives_random_bytes_inserted_anywhere() -> None:
    rng = np.random.default_rng(0)
    frames = cycles(7000)[:20_000]
    stream = np.frombuffer(serial_port.encode(frames), np.uint8)
    places = np.sort(rng.integers(0, len(stream), 10_000))
    noisy = np.insert(stream, places, rng.integers(0, 256, len(places), np.uint8)).tobytes()
    decoder = Decoder()
    parts = [decoder.push(noisy[k : k + 4096]) for k in range(0, len(noisy), 4096)]
    got = fr.concatenate(parts)
    borders = np.flatnonzero(stream == 0)
    touched = len(np.unique(np.searchsorted(borders, places)))
    assert len(frames) - len(got) <= touched
    assert got.refused["bad_serial_frame"] >= 0.9 * touched
    assert len(contents(got) - contents(frames)) <= 2  # CRC-16 lets one in 65,536 through
    tail = decoder.push(b"\0" + serial_port.encode(frames[:100]))
    assert equal(tail, frames[:100])


def test_endless_line_without_zero_is_bounded() -> None:
    decoder = Decoder()
    for _ in range(50):
        decoder.push(b"\x05" * 1000)
    assert len(decoder._pending) <= serial_port.MAX_PENDING + 1000
    decoder.push(b"\0")
    assert len(decoder.push(serial_port.encode(cycles(1)))) == 3


def test_serial_frame_is_plain_cobs_and_crc() -> None:
    import binascii

    frames = cycles(1)
    block = serial_port.encode(frames).split(b"\0")[0]
    body = cobs.decode(block)
    assert binascii.crc_hqx(body, 0xFFFF) == 0
    assert body[:4] == int(frames.can_id[0]).to_bytes(4, "little")


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """A pty: file descriptor of the controller's end, and the port's name."""
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for end in (master, slave):
        with contextlib.suppress(OSError):
            os.close(end)


def test_serial_port_over_a_pty(line: tuple[int, str]) -> None:
    master, name = line
    frames = cycles(700)
    stream = b"\x07noise\0" + serial_port.encode(frames)

    def send() -> None:
        view = memoryview(stream)
        while view:
            view = view[os.write(master, view[:2048]) :]

    with SerialPort(name) as source:
        thread = threading.Thread(target=send)
        thread.start()
        got = collect(source, len(frames))
        thread.join()
    assert equal(got, frames)
    assert got.refused == {"bad_serial_frame": 1}


def test_unplugged_serial_port_is_an_error(line: tuple[int, str]) -> None:
    master, name = line
    with SerialPort(name) as source, pytest.raises(SourceError):
        os.close(master)
        for _ in range(50):
            source.read()
