from __future__ import annotations

import time
from collections import Counter
from random import Random

import can
import numpy as np
import pytest
from can.interfaces.slcan import slcanBus
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler
from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.sources import slcan_lines
from firmware_bridge.sources.live import SourceError
from firmware_bridge.sources.live_bus import open_live
from firmware_bridge.sources.slcan import Slcan, Spaced
from firmware_bridge.sources.slcan_lines import Decoder
from tests.bridge.machine import CATALOG, START_US, assembly, cycles, equal
from tests.bridge.test_live import collect
from tests.bridge.wire import KINDS, Pty, contents, noisy, read_until


def lines(frames: Frames, stamps_ms: np.ndarray | None = None) -> bytes:
    """What an adapter sends for these frames."""
    out = []
    for k in range(len(frames)):
        can_id, n = int(frames.can_id[k]), int(frames.length[k])
        head = f"T{can_id & 0x1FFFFFFF:08X}" if can_id & EXTENDED else f"t{can_id:03X}"
        stamp = "" if stamps_ms is None else f"{int(stamps_ms[k]):04X}"
        out.append(f"{head}{n}{frames.data[k, :n].tobytes().hex().upper()}{stamp}\r")
    return "".join(out).encode()


def push(text: bytes, stamped: bool = False) -> tuple[list[tuple[int, int, bytes]], dict[str, int]]:
    got = Decoder(stamped).push(text)
    return contents(got), got.refused


@given(
    st.lists(
        st.tuples(
            st.one_of(st.integers(0, 2**11 - 1), st.integers(EXTENDED, EXTENDED + 2**29 - 1)),
            st.binary(max_size=8),
            st.integers(0, 59_999),
        ),
        max_size=30,
    ),
    st.booleans(),
    st.randoms(use_true_random=False),
)
@settings(max_examples=60, deadline=None)
def test_stream_cut_anywhere(
    content: list[tuple[int, bytes, int]], stamped: bool, random: Random
) -> None:
    frames = fr.empty(len(content))
    for k, (can_id, data, stamp) in enumerate(content):
        frames.can_id[k], frames.length[k] = can_id, len(data)
        frames.data[k, : len(data)] = list(data)
        frames.t_us[k] = 1000 * stamp if stamped else 0
    text = lines(frames, frames.t_us // 1000 if stamped else None)
    decoder, parts = Decoder(stamped), []
    while text:
        size = random.randint(1, 40)
        parts.append(decoder.push(text[:size]))
        text = text[size:]
    got = fr.concatenate(parts)
    assert equal(got, frames)
    assert not got.refused


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"t1238112233\r", "bad_line"),  # python-can: dlc 8 with 3 bytes
        (b"t12311\r", "bad_line"),  # half a byte
        (b"t123111223344\r", "bad_line"),  # too long: neither data nor stamp
        (b"t12391122334455667788AA\r", "bad_line"),  # dlc 9
        (b"t8001AA\r", "bad_line"),  # no 11 bit identifier
        (b"T200000001AA\r", "bad_line"),  # no 29 bit identifier
        (b"t12x1AA\r", "bad_line"),
        (b"t1231\xffA\r", "bad_line"),
        (b"\x80\x81\r", "bad_line"),
        (b"hello\r", "bad_line"),
        (b"t1231AA\x07", "bad_line"),  # ended by a bell
        (b"T\r", "bad_line"),
        (b"r1238\r", "remote_frame"),
        (b"R000001238\r", "remote_frame"),
        (b"d1239112233445566778899AABBCC\r", "fd_frame"),
        (b"\x07", "adapter_error"),
    ],
)
def test_what_is_no_data_frame_is_counted_by_reason(text: bytes, reason: str) -> None:
    good = b"t0212BEEF\r"
    assert push(good + text + b"\r" + good) == ([(0, 0x21, b"\xbe\xef")] * 2, {reason: 1})


def test_answers_are_no_frames_and_no_damage() -> None:
    assert push(b"\r\r\r") == ([], {})


def test_a_damaged_end_of_line_loses_one_frame_only() -> None:
    second = (0, 0x122, b"\x02")
    assert push(b"t1211011t1221" + b"02\r") == ([second], {"bad_line": 1})
    assert push(b"t12110102t122102\r") == ([second], {"bad_line": 1})
    assert push(b"t1211" + b"01\x8dT8000012210" + b"t122102\r") == ([second], {"bad_line": 1})


def test_stamps_are_believed_after_four_frames_in_a_row() -> None:
    plain, stamped = b"t1212BEEF\r", b"t1212BEEF0010\r"
    got = Decoder().push(plain + stamped * 3 + plain + stamped * 10)
    assert got.t_us.tolist() == [0, 0] + [16_000] * 7
    assert got.refused == {"bad_line": 6}
    assert push(b"t1212BEEFEA60\r", stamped=True) == ([], {"bad_line": 1})  # 60,000 ms


def test_one_high_byte_does_not_wedge() -> None:
    """python-can's reader refuses everything after it."""
    frames = cycles(10)
    frames.t_us[:] = 0
    for k in range(0x80, 0x100):
        got = Decoder().push(bytes([k]) + lines(frames))
        assert len(got) >= len(frames) - 1


def test_endless_line_is_bounded() -> None:
    decoder = Decoder()
    for _ in range(50):
        decoder.push(b"1" * 1000)
    assert len(decoder._pending) <= slcan_lines.MAX_LINE
    got = decoder.push(b"\r" + lines(cycles(1)))
    assert len(got) == 3
    assert got.refused == {"bad_line": 1}


@pytest.mark.parametrize("kind", KINDS)
def test_line_noise_over_a_pty(line: Pty, kind: str) -> None:
    """Fault 13: 10,000 random bad bytes among 100,000 frames.

    slcan has no checksum: a digit that becomes another digit passes here, and the CRC and counter
    of the payload must refuse it.
    """
    frames, n_bad = cycles(33_334)[:100_000], 10_000
    text, sentinel = lines(frames), cycles(1, seed=9)
    damaged, _ = noisy(text, n_bad, KINDS.index(kind), kind)
    with Slcan(line.name) as source:
        thread = line.feed(damaged + b"\r" + lines(sentinel))
        got = read_until(source, sentinel, stamps=False)
        thread.join()
    got = got[: len(got) - len(sentinel)]
    sent, arrived = Counter(contents(frames, False)), Counter(contents(got, False))
    wrong = (arrived - sent).total()
    lost = len(frames) - (len(got) - wrong)
    assert lost <= n_bad
    assert wrong <= 0.11 * n_bad  # 15 other digits of 255 other bytes, and inserted ones

    passed = [k for k, seen in enumerate(contents(got, False)) if seen not in sent]
    assembler = Assembler(CATALOG, assembly())
    assembler.push(got[np.array(passed, np.intp)])
    refused = assembler.counters
    caught = sum(refused.get(name, 0) for name in ("crc", "unknown_id", "wrong_length"))
    assert caught >= len(passed) - 1  # CRC-8 finds every single wrong digit, 255 of 256 of others


def commands_to(pty: Pty) -> list[str]:
    heard: list[str] = []

    def reply(command: bytes) -> bytes:
        heard.append(command.decode())
        return b"\r"

    pty.answer(reply)
    return heard


def wait_for(heard: list[str], last: str) -> None:
    end_s = time.monotonic() + 5.0
    while last not in heard[-1:] and time.monotonic() < end_s:
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"bitrate": 500_000}, ["", "", "C", "S6", "Z0", "L"]),
        ({"bitrate": 1_000_000, "stamped": True}, ["", "", "C", "S8", "Z1", "L"]),
        ({"listen_only": False}, ["", "", "C", "Z0", "O"]),
    ],
)
def test_opening_commands(line: Pty, options: dict[str, int], expected: list[str]) -> None:
    heard = commands_to(line)
    source = Slcan(line.name, **options)  # type: ignore[arg-type]
    wait_for(heard, expected[-1])
    assert heard == expected
    source.stop()
    wait_for(heard, "C")
    assert heard[-1] == "C"


def test_unknown_bitrate_and_port_are_plain_errors(line: Pty) -> None:
    with pytest.raises(SourceError, match="choose one of 10000, 20000"):
        Slcan(line.name, 123)
    with pytest.raises(SourceError, match="cannot open serial port"):
        Slcan("/dev/no_such_port")


def test_project_interface_slcan_is_the_bulk_source(line: Pty) -> None:
    frames = cycles(300)
    with open_live("slcan", line.name + "@2000000", bitrate=500_000) as source:
        assert isinstance(source, Slcan)
        thread = line.feed(lines(frames))
        got = collect(source, len(frames))
        thread.join()
    assert contents(got, False) == contents(frames, False)
    assert (np.diff(got.t_us) > 0).all()
    assert abs(int(got.t_us[-1]) - time.time_ns() // 1000) < 10_000_000


def test_reads_as_pythoncan_does(line: Pty) -> None:
    frames = cycles(100)
    with Slcan(line.name) as source:
        line.feed(lines(frames)).join()
        ours = collect(source, len(frames))
    commands_to(line)
    bus = slcanBus(line.name, sleep_after_open=0)
    line.feed(lines(frames)).join()
    theirs: list[can.Message] = []
    while len(theirs) < len(frames):
        message = bus.recv(1.0)
        assert message is not None
        theirs.append(message)
    bus.shutdown()
    assert contents(ours, False) == contents(fr.from_messages(theirs), False)


def test_stamps_roll_over_and_drift(line: Pty) -> None:
    """Three roll-overs of 60 s, 1 ms steps, 150 ppm: times follow the host within 1.5 ms."""
    rng = np.random.default_rng(2)
    n = 2000
    true_us = START_US + 100_000 * np.arange(n)
    own_ms = np.rint((true_us - START_US) * (1 - 150e-6)).astype(np.int64) // 1000 + 59_000
    frames = cycles(n)[:n]
    text = lines(frames, own_ms % 60_000).split(b"\r")[:-1]
    arrived_us = true_us + rng.integers(0, 1000, n)
    source = Slcan(line.name, stamped=True)
    got = source._convert([(int(a), t + b"\r") for a, t in zip(arrived_us, text, strict=True)])
    source.stop()
    assert not got.refused
    error_us = got.t_us - true_us
    assert (np.diff(got.t_us) > 0).all()
    assert np.abs(error_us[n // 2 :]).max() < 1500


def test_frames_of_one_piece_are_spaced_by_their_time_on_the_bus() -> None:
    frames = cycles(4)[:10]  # 111 bits each
    arrived_us = np.repeat([1_000_000, 1_000_300], [4, 6])
    got = Spaced(1_000_000).push(frames, arrived_us)
    assert got.t_us.tolist() == [
        999_667, 999_778, 999_889, 1_000_000, 1_000_001, 1_000_002, 1_000_003,
        1_000_078, 1_000_189, 1_000_300,
    ]  # fmt: skip
