"""The receiver in C against any frames at all: sizes, broken maps, soups; under sanitisers too."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge import lookup, protocol
from firmware_bridge.download import DownloadError, Image, Session, download
from firmware_bridge.protocol import Op, Reason
from tests.bridge.controller import COMPILER, SOURCES, STRICT, Controller, Line
from tests.bridge.downloads import (
    IS_OLD,
    NEW,
    OLD,
    asked,
    begun,
    broken_images,
    is_active,
    run,
    state,
    whole,
)
from tests.bridge.tables import a_table


def test_damage_behind_a_good_crc_8_is_found_at_the_end() -> None:
    controller, spoilt = begun(), list[bytes]()

    def spoil(data: bytes, is_answer: bool) -> list[bytes]:
        if not is_answer and data[0] == 0x80 + 70 and len(spoilt) < 2:
            spoilt.append(data)
            frame = bytearray(data)
            frame[3] ^= 0x10
            session = next(s for s in range(1 << 16) if protocol.crc8(s, data) == data[7])
            frame[7] = protocol.crc8(session, bytes(frame))
            return [bytes(frame)]
        return [data]

    line = Line(controller, spoil)
    session = Session(line, 5)
    session.open()
    session.put(0, NEW[0], 6, lambda done, total: None)
    assert len(spoilt) == 2 and session.repeated >= NEW[0].chunks
    assert is_active(controller, OLD[0])
    session.commit([0], 6)
    assert is_active(controller, NEW[0])


def test_room_counts_for_nodes_and_for_flows() -> None:
    image = Image(lookup.image(a_table(20, 15), 0))
    for nodes, counts, fits in ((35, 300, True), (34, 300, False), (35, 299, False)):
        session = Session(Line(Controller(1, nodes, counts)))
        room = session.open()
        assert (room.nodes, room.counts, room.slots) == (nodes, counts, 1)
        if fits:
            download(session, {0: image}, 1)
            continue
        with pytest.raises(DownloadError) as refused:
            download(session, {0: image}, 1)
        assert refused.value.reason == Reason.SIZE


def test_the_largest_map() -> None:
    image = Image(lookup.image(a_table(255, 255), 0))
    controller = Controller(1, 510, 0xFFFF)
    session = Session(Line(controller))
    session.open()
    download(session, {0: image}, 1)
    assert len(image.data) > 190_000 and is_active(controller, image)


def test_a_size_that_contradicts_the_nodes() -> None:
    controller = begun()
    controller.push(protocol.open_frame(3))
    for size in (len(NEW[0].data) - 1, len(NEW[0].data) + 1, 0, 0xFFFFFF):
        *_, last = protocol.begin_frames(3, 0, 25, 18, size, 6, NEW[0].crc)
        for data in protocol.begin_frames(3, 0, 25, 18, size, 6, NEW[0].crc)[:2]:
            controller.push(data)
        assert asked(controller, last)[3] == Reason.SIZE


def test_data_without_a_beginning() -> None:
    controller = begun()
    controller.push(protocol.open_frame(3))
    for k in range(NEW[0].chunks):
        controller.push(protocol.data_frame(3, k, NEW[0].data))
    assert asked(controller, protocol.frame(3, Op.END, b"\0"))[3] == Reason.ORDER
    *_, last = protocol.begin_frames(3, 0, 25, 18, len(NEW[0].data), 6, NEW[0].crc)
    assert asked(controller, last)[3] == Reason.ORDER
    first, *_ = protocol.begin_frames(3, 0, 25, 18, len(NEW[0].data), 6, NEW[0].crc)
    controller.push(first)
    assert asked(controller, last)[3] == Reason.ORDER, "the version is missing"


def test_data_before_the_size_is_judged_are_not_stored() -> None:
    """Else an absurd size would write beyond the room; under sanitisers as well."""
    head, *_ = protocol.begin_frames(3, 0, 255, 255, 0xFFFFFF, 6, 1)
    chunks = [protocol.data_frame(3, k, bytes(0xFFFF)) for k in range(3000)]
    controller = begun()
    for data in (protocol.open_frame(3), head, *chunks):
        controller.push(data)
    assert controller.counts[2] == len(chunks) and state(controller) == IS_OLD
    run([protocol.open_frame(3), head, *chunks])


def test_limits_hold_at_both_ends() -> None:
    table = a_table(10, 8)
    below = replace(table, w_v=table.w_v - np.float32(11.0), safe_band_v=-11.0)
    controller = Controller(1)
    controller.limit(5.0, 0, 0)
    session = Session(Line(controller))
    session.open()
    with pytest.raises(DownloadError) as refused:
        download(session, {0: Image(lookup.image(below, 0))}, 1)
    assert refused.value.reason == Reason.LIMITS


@pytest.mark.parametrize("data", broken_images())
def test_an_implausible_map_is_refused_whole_as_it_is(data: bytes) -> None:
    controller = begun()
    session = Session(Line(controller))
    session.open()
    frames = protocol.begin_frames(session._session, 0, 6, 5, len(data), 6, Image(data).crc)
    assert session._reply(frames, 0)[0] == Reason.DONE
    session._transfer(0, Image(data), lambda done, total: None)
    end = protocol.frame(session._session, Op.END, b"\0")
    assert session._reply([end], 0)[0] in (Reason.CONTENT, Reason.LIMITS)
    with pytest.raises(DownloadError):
        session.commit([0], 6)
    assert state(controller) == IS_OLD


GOOD = whole(NEW, 6, 7)


@st.composite
def soups(draw: st.DrawFn) -> list[bytes]:
    """A real download, cut, repeated, mixed and damaged anywhere, and frames out of nothing."""
    frames = [list(frame) for frame in GOOD]
    for _ in range(draw(st.integers(0, 12))):
        k = draw(st.integers(0, len(frames) - 1))
        kind = draw(st.integers(0, 5)) if len(frames[k]) == 8 else 5
        if kind == 0:
            del frames[k : k + draw(st.integers(1, 40))]
            frames = frames or [list(GOOD[0])]
        elif kind == 1:
            frames.insert(k, list(draw(st.sampled_from(GOOD))))
        elif kind == 2:
            frames[k] = [*frames[k]]
            frames[k][draw(st.integers(0, 7))] ^= 1 << draw(st.integers(0, 7))
        elif kind == 3:  # damaged behind a good CRC
            spoilt = bytearray(frames[k])
            spoilt[draw(st.integers(0, 6))] ^= 1 << draw(st.integers(0, 7))
            session = 0 if spoilt[0] == Op.OPEN else 7
            frames[k] = list(spoilt[:7]) + [protocol.crc8(session, bytes(spoilt))]
        elif kind == 4:
            op, body = draw(st.integers(0, 255)), draw(st.binary(min_size=6, max_size=6))
            frames.insert(k, list(protocol.frame(7, op, body)))
        else:
            frames.insert(k, list(draw(st.binary(max_size=8))))
    return [bytes(frame) for frame in frames]


@settings(max_examples=300, deadline=None)
@given(soups())
def test_no_soup_of_bytes_activates_a_wrong_map(frames: list[bytes]) -> None:
    """Active is what was active, or a map whose bytes have the CRC that was announced for it."""
    controller = begun()
    before = {slot: controller.held(slot) for slot in (0, 1)}
    known = {image.crc for image in (*OLD.values(), *NEW.values())}
    for data in frames:
        controller.push(data)
    for slot in (0, 1):
        held = controller.held(slot)
        if held != before[slot]:
            assert held is not None and held[0] > 5
            assert held[1] in known, "a map that nobody sent is active"
            if slot == 0:
                assert is_active(controller, NEW[0] if held[1] == NEW[0].crc else OLD[0])
    q, status = controller.flow(0, [3.0, 7.0], [1e6, 2e6])
    assert (abs(q) < 1e-2).all() and (status < 7).all()


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(soups(), st.lists(st.binary(min_size=8, max_size=8), max_size=50))
def test_the_receiver_is_clean_under_sanitisers(frames: list[bytes], noise: list[bytes]) -> None:
    run(frames + noise)


def test_under_sanitisers_a_good_download_arrives() -> None:
    """The program has room for 64 nodes and 400 flows: NEW's 25 x 18 do not fit, OLD's do."""
    assert b"0 0 0\n" in run(GOOD)
    out = run(whole(OLD, 6, 3))
    assert f"1 6 {OLD[0].crc}\n".encode() in out and f"1 6 {OLD[1].crc}\n".encode() in out
    for data in broken_images():
        session = protocol.open_frame(3)
        frames = protocol.begin_frames(3, 0, 6, 5, len(data), 6, Image(data).crc)
        chunks = [protocol.data_frame(3, k, data) for k in range(Image(data).chunks)]
        end = protocol.frame(3, Op.END, b"\0")
        run([session, *frames, *chunks, end, protocol.commit_frame(3, [0], 6)])


def test_the_firmware_of_the_page_compiles(tmp_path: Path) -> None:
    """download.md's example, with what the machine's firmware would bring."""
    if COMPILER is None:
        pytest.skip("no compiler")
    page = (SOURCES.parent / "download.md").read_text("utf-8")
    example = page.partition("```c\n")[2].partition("```")[0]
    declared = (
        "#include <stdint.h>\n#define REPLY_ID 0x701\nuint32_t clock_ms(void);\n"
        "void can_send(uint32_t id, const uint8_t *data, int length);\n"
        "float fallback(float q, float dp);\nvoid maps_init(void);\n"
        "void on_can_frame(const uint8_t *data, uint8_t length);\n"
        "float command_for(float q_m3s, float dp_pa);\n"
    )
    file = tmp_path / "firmware.c"
    file.write_text(declared + example)
    command = [COMPILER, *STRICT, f"-I{SOURCES}", "-c", str(file), "-o", str(tmp_path / "o")]
    subprocess.run(command, check=True)
