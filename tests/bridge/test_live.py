from __future__ import annotations

import contextlib
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator

import can
import pytest
from can.interfaces.virtual import VirtualBus

from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.playback import BusSink
from firmware_bridge.sources.can_bus import CanBus
from firmware_bridge.sources.live import Source, SourceError
from firmware_bridge.sources.serial_port import SerialPort
from firmware_bridge.sources.sockets import enlarge_buffer, hear_one_group
from tests.bridge.machine import CATALOG, assembly, cycles, equal
from tests.faults.process import a_group


def collect(source: Source, n: int, limit_s: float = 10.0) -> Frames:
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


def test_a_sink_hears_its_own_group_alone() -> None:
    """Two of python-can's test buses on one computer are one, as far as Linux delivers."""
    groups = [a_group() for _ in range(2)]
    with contextlib.ExitStack() as stack:
        one, other = (
            stack.enter_context(BusSink("udp_multicast", group, (0x701,)).armed())
            for group in groups
        )
        speaker = stack.enter_context(can.Bus(groups[1], interface="udp_multicast"))
        speaker.send(can.Message(arbitration_id=0x701, is_extended_id=False))
        assert other.recv(10.0) is not None
        assert one.recv(0.2) is None


@pytest.mark.parametrize("asks", [enlarge_buffer, hear_one_group])
def test_a_bus_that_is_no_socket_leaves_nothing_open(asks: Callable[[can.BusABC], None]) -> None:
    """A port that was opened anew each second used up the process' descriptors."""

    class OnPort(VirtualBus):
        def fileno(self) -> int:
            return at

    with tempfile.TemporaryFile() as port, OnPort("on-port") as bus:
        at = port.fileno()
        before = len(os.listdir("/proc/self/fd"))
        asks(bus)
        assert len(os.listdir("/proc/self/fd")) == before


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


class Failing(CanBus):
    """A bus whose driver fails for a while, as after bus-off."""

    def __init__(self, fault_s: float) -> None:
        self.fault_s, self.end_s = fault_s, 0.0
        super().__init__("virtual", "failing", reopen_s=60.0)

    def _receive(self) -> can.Message | None:
        if not self.end_s:
            self.end_s = time.monotonic() + self.fault_s
        if time.monotonic() < self.end_s:
            raise can.CanOperationError("bus-off")
        return super()._receive()

    def _open(self) -> None:
        if time.monotonic() < self.end_s:
            raise SourceError("interface down")
        super()._open()


def test_bus_that_fails_is_opened_again() -> None:
    """Fault 11: recovery within 2.5 s of the end of the fault."""
    with Failing(fault_s=1.5) as source:
        got = source.read(0.0)
        while "reopened" not in got.refused:
            got = source.read(0.1)
            assert not source.end_s or time.monotonic() < source.end_s + 2.5
        with can.Bus(interface="virtual", channel="failing") as sender:
            sender.send(can.Message(arbitration_id=7), timeout=1.0)
            assert len(collect(source, 1)) == 1


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
