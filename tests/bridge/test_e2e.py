"""End-to-end protection as in AUTOSAR E2E Profile 1: CRC over data id and payload, counter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge import e2e
from firmware_bridge.assemble import Assembler
from firmware_bridge.config import Assembly
from firmware_bridge.frames import Frames
from tests.bridge.machine import CATALOG, MESSAGES, assembly, cycles, without


def plain_crc(data: bytes) -> int:
    """CRC-8, polynomial 0x1D, start and XOR value 0, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
    return crc


def counters(frames: Frames, declared: Assembly) -> dict[str, int]:
    assembler = Assembler(CATALOG, declared)
    assembler.push(frames)
    return assembler.counters


def with_messages(**changes: object) -> Assembly:
    declared = assembly()
    messages = tuple(replace(m, **changes) for m in declared.messages)  # type: ignore[arg-type]
    return replace(declared, messages=messages)


def test_published_check_value() -> None:
    """CRC-8/SAE-J1850-ZERO of "123456789" is 0x37."""
    assert plain_crc(b"123456789") == 0x37
    data = np.frombuffer(b"\x00" + b"3456789", np.uint8)[None]
    assert e2e.crc8_bulk(data, 8, 0, int.from_bytes(b"12", "little"))[0] == 0x37


@given(st.binary(min_size=8, max_size=8), st.integers(1, 8), st.integers(0, 0xFFFF), st.data())
def test_crc_covers_the_data_id_and_all_bytes_but_its_own(
    payload: bytes, length: int, data_id: int, data: st.DataObject
) -> None:
    byte = data.draw(st.integers(0, length - 1))
    rest = payload[:byte] + payload[byte + 1 : length]
    got = e2e.crc8_bulk(np.frombuffer(payload, np.uint8)[None], length, byte, data_id)[0]
    assert got == plain_crc(data_id.to_bytes(2, "little") + rest)


@pytest.mark.parametrize("damage", ["one bit", "two bits", "one byte"])
def test_small_errors_are_always_found(damage: str) -> None:
    rng = np.random.default_rng(1)
    frames = cycles(4000)
    rows, places = np.arange(len(frames)), rng.integers(0, 64, len(frames))
    if damage == "one byte":
        frames.data[rows, places // 8] ^= rng.integers(1, 256, len(frames)).astype(np.uint8)
    else:
        frames.data[rows, places // 8] ^= (1 << places % 8).astype(np.uint8)
    if damage == "two bits":
        others = (places + rng.integers(1, 64, len(frames))) % 64
        frames.data[rows, others // 8] ^= (1 << others % 8).astype(np.uint8)
    assert counters(frames, assembly()) == {"crc": len(frames)}


def test_flipped_bits_pass_in_less_than_045_per_cent() -> None:
    """Fault 4: 100,000 frames, each with 3 to 64 bits of its payload flipped at random."""
    rng = np.random.default_rng(0)
    frames = cycles(33_334)[:100_000]
    flips = rng.random((len(frames), 64)) < rng.uniform(0.05, 0.5, (len(frames), 1))
    flips[np.arange(len(frames))[:, None], rng.integers(0, 64, (len(frames), 3))] = True
    frames.data[:] ^= np.packbits(flips, axis=1)
    passed = len(frames) - counters(frames, assembly())["crc"]
    assert 0.003 * len(frames) < passed <= 0.0045 * len(frames)  # 1 in 256 is 0.39 %


def test_a_frame_of_another_message_is_never_taken_for_this_one() -> None:
    """Masquerade: the right CRC for the wrong data id."""
    frames = cycles(1000)
    ids = [CATALOG.can_id(name) for name in MESSAGES]
    for own, other in zip(ids, ids[1:] + ids[:1], strict=True):
        wrong = frames[frames.can_id == own]
        wrong.can_id[:] = other
        assert counters(wrong, assembly()) == {"crc": len(wrong)}


def test_data_id_and_names_are_a_choice_per_message() -> None:
    frames = cycles(100)
    assert not counters(frames, assembly())
    assert counters(frames, with_messages(data_id=7))["crc"] == len(frames)
    assert not counters(frames, with_messages(crc=None, data_id=7))
    frames.data[:, 0] ^= 1
    assert not counters(frames, with_messages(crc=None))


def test_counter_faults_have_their_own_names() -> None:
    frames = cycles(200)
    valve = np.flatnonzero(frames.can_id == CATALOG.can_id("ValveCommand"))
    repeated = frames[np.sort(np.append(np.arange(len(frames)), valve[50]))]
    repeated.t_us[valve[50] + 1] += 10  # the same content a little later
    assert counters(repeated, assembly())["counter_repeat"] == 1
    assert counters(without(frames, [int(valve[50])]), assembly())["counter_jump"] == 1
    frames.data[valve[50], 2] ^= 4
    assert counters(frames, assembly())["crc"] == 1
