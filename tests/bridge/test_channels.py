"""One project on two buses: the same identifiers mean different messages there."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import can
import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler
from firmware_bridge.config import CYCLE, MULTIRATE, Assembly
from firmware_bridge.frames import Frames
from firmware_bridge.playback import AS_FAST_AS_POSSIBLE, send
from firmware_bridge.samples import Samples
from firmware_bridge.sources import open_log
from firmware_bridge.sources.can_bus import CanBus
from firmware_bridge.sources.live import SourceError
from firmware_bridge.sources.live_bus import _numbers, open_live
from firmware_bridge.sources.several import Several
from tests.bridge.machine import CATALOG, assembly, cycles, equal

CHANNEL = {"ValveCommand": 0, "Pressures": 1, "Motion": 1}


def two_channels(mode: str) -> Assembly:
    declared = assembly(mode)
    messages = [replace(m, channel=CHANNEL[m.name]) for m in declared.messages]
    return replace(declared, messages=tuple(messages))


def on_two_buses(n: int) -> Frames:
    """Each message on its channel; on the other one the same identifiers with other content."""
    true, foreign = cycles(n), cycles(n, seed=5)
    for name, number in CHANNEL.items():
        true.channel[true.can_id == CATALOG.can_id(name)] = number
        foreign.channel[foreign.can_id == CATALOG.can_id(name)] = 1 - number
    return fr.by_time(fr.concatenate([true, foreign]))


def samples_of(frames: Frames, mode: str) -> Samples:
    return Assembler(CATALOG, two_channels(mode)).push(frames)


def wanted(n: int, mode: str) -> Samples:
    return Assembler(CATALOG, assembly(mode)).push(cycles(n))


@pytest.mark.parametrize("mode", [CYCLE, MULTIRATE])
@pytest.mark.parametrize("suffix", [".blf", ".log", ".asc", ".trc"])
def test_from_a_log(tmp_path: Path, suffix: str, mode: str) -> None:
    """Not from python-can's CSV, which has no column for the channel."""
    path, frames = tmp_path / f"two{suffix}", on_two_buses(300)
    with can.Logger(path) as logger:
        for message in fr.to_messages(frames):
            logger(message)
    got, expected = samples_of(open_log(path), mode), wanted(300, mode)
    np.testing.assert_array_equal(got.values, expected.values)
    assert len(got) >= 290


@pytest.mark.parametrize("mode", [CYCLE, MULTIRATE])
def test_live_from_two_virtual_buses(mode: str) -> None:
    frames, names = on_two_buses(300), [f"{uuid4().hex}-{k}" for k in (0, 1)]
    with open_live("virtual", ",".join(names)) as source:
        threads = []
        for number, name in enumerate(names):
            bus = can.Bus(name, interface="virtual", preserve_timestamps=True)
            mine = fr.to_messages(frames[frames.channel == number])
            threads.append(threading.Thread(target=send, args=(bus, mine, AS_FAST_AS_POSSIBLE)))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        time.sleep(0.2)
        got = source.read()
    for number in (0, 1):
        assert equal(got[got.channel == number], frames[frames.channel == number])
    live, expected = samples_of(got, mode), wanted(300, mode)
    assert live.values.tobytes() == expected.values.tobytes()
    assert live.t_us.tobytes() == expected.t_us.tobytes()


def test_a_silent_channel_does_not_delay_the_other() -> None:
    names = [f"{uuid4().hex}-{k}" for k in (0, 1)]
    sender = can.Bus(names[1], interface="virtual")
    with open_live("virtual", ",".join(names)) as source:
        sender.send(can.Message(arbitration_id=1), timeout=1.0)
        got = source.read(timeout_s=60.0)
    sender.shutdown()
    assert got.channel.tolist() == [1]
    assert source.is_over


def test_merging_keeps_the_order_of_arrival_within_a_channel() -> None:
    class Given(CanBus):
        def __init__(self, t_us: list[int]) -> None:
            super().__init__("virtual", uuid4().hex)
            self.messages = [can.Message(timestamp=t * 1e-6, arbitration_id=t) for t in t_us]
            for message in self.messages:
                self._put(message)

    both = Several({3: Given([10, 30, 20, 40]), 7: Given([15, 35, 50])})
    got = both.read()
    both.stop()
    assert got.can_id.tolist() == [fr.EXTENDED | t for t in (10, 15, 30, 20, 35, 40, 50)]
    assert got.channel.tolist() == [3, 7, 3, 3, 7, 3, 7]


def test_numbers_come_from_the_names_where_they_tell_them_apart() -> None:
    assert _numbers(["can1", "can3"]) == [1, 3]
    assert _numbers(["/dev/serial/by-id/a-if00", "/dev/serial/by-id/b-if00"]) == [0, 1]


def test_one_channel_that_cannot_be_opened_closes_the_other() -> None:
    with pytest.raises(SourceError, match="cannot open serial port /dev/no_such_port"):
        open_live("serial", "/dev/ptmx, /dev/no_such_port")
    with pytest.raises(SourceError, match="name its port"):
        open_live("slcan")
