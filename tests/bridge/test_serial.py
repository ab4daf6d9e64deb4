from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from random import Random

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge import frames as fr
from firmware_bridge.frames import EXTENDED
from firmware_bridge.sources import serial_port
from firmware_bridge.sources.live import SourceError
from firmware_bridge.sources.port import split_baudrate
from firmware_bridge.sources.serial_port import Decoder, SerialPort
from tests.bridge.machine import cycles, equal
from tests.bridge.test_live import collect
from tests.bridge.wire import KINDS, Pty, contents, noisy, read_until

IDS = st.one_of(st.integers(0, 2**11 - 1), st.integers(EXTENDED, EXTENDED + 2**29 - 1))


@given(st.lists(IDS, min_size=1, max_size=30), st.randoms(use_true_random=False))
@settings(max_examples=40, deadline=None)
def test_stream_cut_anywhere(ids: list[int], random: Random) -> None:
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


def test_frame_is_plain_cobs_and_crc() -> None:
    import binascii

    frames = cycles(1)
    before, block, behind = serial_port.encode(frames[:1]).split(b"\0")
    body = cobs.decode(block)
    assert before == behind == b""
    assert int.from_bytes(body[-2:], "big") == binascii.crc_hqx(body[:-2], 0xFFFF) ^ 0xFFFF
    assert body[:4] == int(frames.can_id[0]).to_bytes(4, "little")


@pytest.mark.parametrize("can_id", [0x800, 0x2000_0000, EXTENDED | 0x2000_0000])
def test_identifiers_that_cannot_be_are_refused(can_id: int) -> None:
    frames = cycles(1)[:1]
    frames.can_id[:] = can_id
    got = Decoder().push(serial_port.encode(frames))
    assert len(got) == 0
    assert got.refused == {"bad_serial_frame": 1}


def test_endless_line_without_zero_is_bounded_and_one_bad_frame() -> None:
    decoder = Decoder()
    for _ in range(50):
        assert not decoder.push(b"\x05" * 1000).refused
    assert len(decoder._pending) <= serial_port.MAX_PENDING
    got = decoder.push(b"\0" + serial_port.encode(cycles(1)))
    assert len(got) == 3
    assert got.refused == {"bad_serial_frame": 1}


@pytest.mark.parametrize("kind", KINDS)
def test_line_noise_over_a_pty(line: Pty, kind: str) -> None:
    """Fault 13: 10,000 random bad bytes among 100,000 frames."""
    frames, n_bad = cycles(33_334)[:100_000], 10_000
    stream = serial_port.encode(frames)
    damaged, places = noisy(stream, n_bad, KINDS.index(kind), kind)
    sentinel = cycles(1, seed=9)
    sentinel.t_us[:] += 60_000_000
    with SerialPort(line.name) as source:
        thread = line.feed(damaged + serial_port.encode(sentinel))
        got = read_until(source, sentinel)
        thread.join()
    wrong = Counter(contents(got)) - Counter(contents(frames)) - Counter(contents(sentinel))
    ends = np.cumsum([len(part) + 2 for part in stream[1:-1].split(b"\0\0")])
    touched = len(np.unique(np.searchsorted(ends, places, "right")))
    lost = len(frames) - (len(got) - len(sentinel) - wrong.total())
    assert wrong.total() == 0
    assert lost <= touched <= n_bad
    assert got.refused["bad_serial_frame"] >= 0.9 * lost


def test_crc_lets_hardly_anything_through() -> None:
    """Of damaged frames 2^-16 = 1.5e-5 would pass the CRC alone."""
    rng = np.random.default_rng(3)
    frames = cycles(30_000)
    length = 25  # of each coded frame of 8 data bytes, both 0x00 included
    text = np.frombuffer(serial_port.encode(frames), np.uint8).reshape(-1, length)
    passed = tried = 0
    for _ in range(10):
        damaged = text.copy()
        damaged[:, 1:-1] = np.where(
            rng.random((len(text), length - 2)) < 0.1,
            rng.integers(0, 256, (len(text), length - 2), np.uint8),
            text[:, 1:-1],
        )
        damaged = damaged[(damaged != text).any(axis=1)]
        got = Decoder().push(damaged.tobytes())
        tried += len(damaged)
        passed += len(got)  # each of them is damaged, some in a way that restores a frame
    assert tried > 800_000
    assert passed <= 1.5e-5 * tried


def test_a_crc_that_ends_in_zero_cannot_lose_it() -> None:
    """A plain CRC would take the last byte before it for its end, in one frame of 256."""
    frames = cycles(2000)
    for text in serial_port.encode(frames)[1:-1].split(b"\0\0"):
        assert len(Decoder().push(b"\0" + text[:-1] + b"\0")) == 0


def test_two_frames_are_never_lost_to_one_byte() -> None:
    frames = cycles(2)[:4]
    stream = serial_port.encode(frames)
    for place in range(len(stream)):
        for value in {0, 1, 255, stream[place] ^ 1} - {stream[place]}:
            damaged = stream[:place] + bytes([value]) + stream[place + 1 :]
            assert len(Decoder().push(damaged)) >= len(frames) - 1, place


def test_port_with_noise_before_the_first_frame(line: Pty) -> None:
    frames = cycles(700)
    with SerialPort(line.name) as source:
        thread = line.feed(b"\x07noise\0" + serial_port.encode(frames))
        got = collect(source, len(frames))
        thread.join()
    assert equal(got, frames)
    assert got.refused == {"bad_serial_frame": 1}


def test_host_time_follows_the_arrivals(line: Pty) -> None:
    frames, late_us = cycles(3000), 500
    frames.t_us[:] -= frames.t_us[0]
    arrived_us = 1_000_000_000 + late_us + frames.t_us
    stream = serial_port.encode(frames)
    size = len(stream) // len(frames)
    source = SerialPort(line.name, host_time=True)
    pieces = [stream[k * size : (k + 1) * size] for k in range(len(frames))]
    got = source._convert(list(zip(arrived_us.tolist(), pieces, strict=True)))
    source.stop()
    np.testing.assert_array_equal(got.t_us, arrived_us)


def test_unplugged_port_is_an_error(line: Pty) -> None:
    with SerialPort(line.name) as source, pytest.raises(SourceError):
        line.unplug()
        for _ in range(50):
            source.read()


def test_adapter_under_another_name_is_found_again(tmp_path: Path) -> None:
    """Fault 12: the link by-id points to a new device; recovery within 3 s."""
    by_id, first, second = tmp_path / "controller", Pty(), Pty()
    by_id.symlink_to(first.name)
    frames = cycles(20)
    stream = serial_port.encode(frames)
    with SerialPort(str(by_id), reopen_s=60.0) as source:
        first.feed(stream + stream[:10]).join()
        assert equal(collect(source, len(frames)), frames)
        by_id.unlink()  # first: another test's pty may get the name, and be read here
        first.unplug()
        time.sleep(0.8)  # long enough for some tries in vain
        by_id.symlink_to(second.name)
        plugged_s, parts = time.monotonic(), [source.read(0.0)]
        while "reopened" not in parts[-1].refused:
            parts.append(source.read(0.1))
            assert time.monotonic() - plugged_s < 3.0
        second.feed(stream).join()
        parts.append(collect(source, len(frames)))
    second.unplug()
    got = fr.concatenate(parts)
    assert equal(got, frames)
    assert got.refused == {"reopened": 1, "bad_serial_frame": 1}  # the frame that was cut


def test_giving_up_after_a_while_is_an_error(line: Pty) -> None:
    with SerialPort(line.name, reopen_s=0.25) as source, pytest.raises(SourceError):
        line.unplug()
        for _ in range(50):
            source.read()


def test_stop_ends_the_tries_to_open_again(line: Pty) -> None:
    source = SerialPort(line.name, reopen_s=60.0).start()
    line.unplug()
    time.sleep(0.2)
    source.stop()
    assert not source._thread.is_alive()
    assert source.is_over


def test_port_names_may_carry_the_baud_rate() -> None:
    assert split_baudrate("/dev/ttyUSB0", 9600) == ("/dev/ttyUSB0", 9600)
    assert split_baudrate("/dev/ttyUSB0@115200", 9600) == ("/dev/ttyUSB0", 115_200)
    with pytest.raises(SourceError, match="baud rate"):
        split_baudrate("/dev/ttyUSB0@fast", 9600)


def test_missing_port_is_a_plain_error() -> None:
    with pytest.raises(SourceError, match="cannot open serial port"):
        SerialPort("/dev/no_such_port")
