"""The map download over lines that lose, repeat, swap and damage; no half map is ever active."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge import lookup, protocol
from firmware_bridge.download import (
    DownloadError,
    Image,
    Session,
    UnconfirmedError,
    download,
)
from firmware_bridge.protocol import Op, Reason
from tests.bridge.controller import COMPILER, SOURCES, STRICT, Controller, Line, sanitised
from tests.bridge.tables import a_table

Spoil = Callable[[bytes, bool], list[bytes]]
OLD = {0: Image(lookup.image(a_table(12, 9, 1), 0)), 1: Image(lookup.numbers_image([8e8, 1e7], 1))}
NEW = {0: Image(lookup.image(a_table(25, 18, 2), 0)), 1: Image(lookup.numbers_image([9e8, 1e6], 1))}


def begun(version: int = 5) -> Controller:
    """A controller that holds OLD."""
    controller = Controller(2)
    session = Session(Line(controller))
    session.open()
    download(session, OLD, version)
    session.close()
    return controller


def state(controller: Controller) -> dict[int, int] | None:
    """The CRC in each slot; None where the slots are of two versions."""
    held = [controller.held(slot) for slot in (0, 1)]
    assert None not in held
    versions = {one[0] for one in held if one}
    assert len(versions) == 1, f"maps of different versions are active together: {held}"
    return {slot: one[1] for slot, one in enumerate(held) if one}


IS_OLD, IS_NEW = ({slot: image.crc for slot, image in images.items()} for images in (OLD, NEW))


def losing(share: float, seed: int) -> Spoil:
    rng = Random(seed)
    return lambda data, _: [] if rng.random() < share else [data]


def repeating(share: float, seed: int) -> Spoil:
    rng = Random(seed)
    return lambda data, _: [data, data] if rng.random() < share else [data]


def swapping(share: float, seed: int) -> Spoil:
    rng = Random(seed)
    kept = {False: b"", True: b""}

    def spoil(data: bytes, is_answer: bool) -> list[bytes]:
        before, kept[is_answer] = kept[is_answer], b""
        if before:
            return [data, before]
        if rng.random() < share:
            kept[is_answer] = data
            return []
        return [data]

    return spoil


def damaging(share: float, seed: int) -> Spoil:
    rng = Random(seed)

    def spoil(data: bytes, is_answer: bool) -> list[bytes]:
        if rng.random() >= share:
            return [data]
        spoilt = bytearray(data)
        for _ in range(rng.randint(1, 8)):
            spoilt[rng.randrange(8)] ^= 1 << rng.randrange(8)
        return [bytes(spoilt)]

    return spoil


SPOILS = {
    "nothing": (losing, 0.0),
    "1 % lost": (losing, 0.01),
    "10 % lost": (losing, 0.1),
    "10 % repeated": (repeating, 0.1),
    "10 % swapped": (swapping, 0.1),
    "3 % damaged": (damaging, 0.03),
}


@pytest.mark.parametrize("name", SPOILS)
def test_maps_arrive_over_a_bad_line(name: str) -> None:
    make, share = SPOILS[name]
    frames = []
    for seed in range(20):
        controller = begun()
        line = Line(controller, make(share, seed))
        session = Session(line)
        session.open()
        download(session, NEW, 6)
        assert state(controller) == IS_NEW
        frames.append(len(line.sent))
    least = sum(image.chunks for image in NEW.values())
    print(f"{name}: {sum(frames) / len(frames) / least:.2f} frames sent per chunk")
    assert max(frames) < 4 * least


@pytest.mark.parametrize("seed", range(10))
def test_a_hopeless_line_ends_in_an_error_and_the_old_maps(seed: int) -> None:
    controller = begun()
    line = Line(controller, losing(0.8, seed))
    with pytest.raises(DownloadError, match=r"does not answer|has not taken"):
        session = Session(line)
        session.open()
        download(session, NEW, 6)
    assert state(controller) == IS_OLD
    assert line.time_s < 60.0


def test_a_dead_controller_is_told_in_two_seconds() -> None:
    line = Line(Controller(), lambda data, is_answer: [])
    with pytest.raises(DownloadError, match="does not answer") as told:
        Session(line).open()
    assert "publish.can_id" in told.value.remedy and line.time_s < 2.0


@pytest.mark.parametrize("after", [1, 3, 5, 40, 150, 250, 270])
def test_a_power_cut_leaves_no_half_map(after: int) -> None:
    """The controller forgets everything but what it had made active."""
    controller, seen = begun(), 0

    def cut(data: bytes, is_answer: bool) -> list[bytes]:
        nonlocal seen
        seen += not is_answer
        return [data] if seen <= after else []

    with pytest.raises(DownloadError):
        session = Session(Line(controller, cut))
        session.open()
        download(session, NEW, 6)
    assert state(controller) == IS_OLD

    session = Session(Line(controller))  # the sender comes back, with a session of its own
    controller.now_ms += 3000
    line = Line(controller, time_s=1e-3 * controller.now_ms)
    session = Session(line)
    session.open()
    download(session, NEW, 6)
    assert state(controller) == IS_NEW


@pytest.mark.parametrize("after", [3, 40, 200, 265])
def test_a_controller_that_starts_anew_in_the_middle(after: int) -> None:
    """It has forgotten the session and its maps: nothing of the rest means anything to it."""
    line = Line(begun())
    new = Controller(2)

    def reboot(data: bytes, is_answer: bool) -> list[bytes]:
        if len(line.sent) > after:
            line.controller = new
        return [data]

    line.spoil = reboot
    session = Session(line)
    session.open()
    with pytest.raises(DownloadError):
        download(session, NEW, 6)
    assert new.held(0) is None and new.held(1) is None
    again = Session(line)
    again.open()
    download(again, NEW, 6)
    assert new.held(0) == (6, NEW[0].crc)


def test_the_active_map_is_not_touched_until_it_is_replaced() -> None:
    controller, seen = begun(), 0
    u, dp = np.linspace(1.0, 10.0, 300), np.linspace(0.0, 6e6, 300)
    before = controller.flow(0, u, dp)[0]

    def look(data: bytes, is_answer: bool) -> list[bytes]:
        nonlocal seen
        if not is_answer and data[0] != Op.COMMIT:
            np.testing.assert_array_equal(controller.flow(0, u, dp)[0], before)
            assert controller.numbers(1) == pytest.approx([8e8, 1e7])
            seen += 1
        return [data]

    session = Session(Line(controller, look))
    session.open()
    download(session, NEW, 6)
    assert seen > 250 and (controller.flow(0, u, dp)[0] != before).any()
    assert controller.numbers(1) == pytest.approx([9e8, 1e6])


class Liar:
    """Answers with anything, in the right session."""

    def __init__(self, seed: int) -> None:
        self._rng, self.told, self.asked = Random(seed), 0, b""

    def tell(self, data: bytes) -> None:
        self.told += 1
        self.asked = data

    def hear(self, timeout_s: float) -> bytes | None:
        if timeout_s == 0.0 or self._rng.random() < 0.3:
            return None
        body = bytearray(self._rng.randbytes(6))
        body[0] = self._rng.choice([self.asked[0], body[0]])
        body[1], body[2] = self._rng.choice([0, 1]), self._rng.choice([0, 0, body[2] % 13])
        if self._rng.random() < 0.7:
            body[4] = 0
        op = self._rng.choice([Op.REPLY, Op.REPLY, Op.ACCEPTS, Op.HELD_CRC, Op.HELD_VERSION])
        return protocol.frame(5, op, bytes(body))


@pytest.mark.parametrize("seed", range(60))
def test_the_sender_ends_whatever_it_is_told(seed: int) -> None:
    link = Liar(seed)
    session = Session(link, 5)
    with contextlib.suppress(DownloadError):
        session.open()
        session.held(0)
        download(session, NEW, 6)
    assert link.told < 20_000


def test_a_lost_confirmation_is_asked_for_again() -> None:
    controller, lost = begun(), 0

    def spoil(data: bytes, is_answer: bool) -> list[bytes]:
        nonlocal lost
        if is_answer and data[:2] == bytes([Op.REPLY, Op.COMMIT]) and lost < 3:
            lost += 1
            return []
        return [data]

    session = Session(Line(controller, spoil))
    session.open()
    download(session, NEW, 6)
    assert lost == 3 and state(controller) == IS_NEW


def test_a_confirmation_that_never_comes_is_told_as_such() -> None:
    controller = begun()

    def spoil(data: bytes, is_answer: bool) -> list[bytes]:
        return [] if is_answer and data[:2] == bytes([Op.REPLY, Op.COMMIT]) else [data]

    session = Session(Line(controller, spoil))
    session.open()
    with pytest.raises(UnconfirmedError, match="does not say"):
        download(session, NEW, 6)
    assert state(controller) == IS_NEW


def test_two_applies_at_once() -> None:
    controller = begun()
    line = Line(controller)
    first, second = Session(line, 1), Session(line, 2)
    first.open()
    first.put(0, NEW[0], 6, lambda done, total: None)
    with pytest.raises(DownloadError, match="another download") as refused:
        second.open()
    assert refused.value.reason == Reason.BUSY
    first.put(1, NEW[1], 6, lambda done, total: None)
    first.commit([0, 1], 6)
    assert state(controller) == IS_NEW
    line.time_s += 2.5  # silence: the session is free
    second.open()
    with pytest.raises(DownloadError):  # and the first one has lost it
        first.held(0)


def test_the_same_session_may_be_opened_again() -> None:
    controller = begun()
    session = Session(Line(controller))
    session.open()
    session.put(0, NEW[0], 6, lambda done, total: None)
    session.open()
    session.put(1, NEW[1], 6, lambda done, total: None)
    session.commit([0, 1], 6)
    assert state(controller) == IS_NEW


@pytest.mark.parametrize("version", [0, 4, 5])
def test_a_version_that_is_not_newer_is_refused(version: int) -> None:
    controller = begun(5)
    session = Session(Line(controller))
    session.open()
    with pytest.raises(DownloadError, match="not newer") as refused:
        download(session, NEW, version)
    assert refused.value.reason == Reason.VERSION
    assert state(controller) == IS_OLD


def test_another_format_is_refused() -> None:
    controller, asked = begun(), bytearray(protocol.open_frame(9))
    asked[3] = protocol.FORMAT + 1
    asked[7] = protocol.crc8(0, bytes(asked))
    (answer,) = controller.push(bytes(asked))
    assert answer[0] == Op.REPLY and answer[3] == Reason.FORMAT


@pytest.mark.parametrize(
    ("slot", "size", "limits", "reason"),
    [
        (2, (10, 10), (0, 0, 0), Reason.SLOT),
        (0, (160, 120), (0, 0, 0), Reason.SIZE),
        (0, (10, 10), (8.0, 0, 0), Reason.LIMITS),
        (0, (10, 10), (0, 1e6, 0), Reason.LIMITS),
        (0, (10, 10), (0, 0, 1e-4), Reason.LIMITS),
        (0, (10, 10), (12.0, 1e7, 1e-3), None),
    ],
)
def test_what_the_controller_refuses(
    slot: int, size: tuple[int, int], limits: tuple[float, float, float], reason: Reason | None
) -> None:
    controller = begun()
    controller.limit(*limits)
    session = Session(Line(controller))
    session.open()
    image = Image(lookup.image(a_table(*size), slot))
    if reason is None:
        download(session, {slot: image}, 6)
        assert controller.held(slot) == (6, image.crc)
        return
    with pytest.raises(DownloadError) as refused:
        download(session, {slot: image}, 6)
    assert refused.value.reason == reason
    assert state(controller) == IS_OLD


def test_not_now() -> None:
    controller = begun()
    controller.hold(True)
    session = Session(Line(controller))
    session.open()
    with pytest.raises(DownloadError) as refused:
        download(session, NEW, 6)
    assert refused.value.reason == Reason.NOT_NOW and state(controller) == IS_OLD
    controller.hold(False)
    session.commit([0, 1], 6)
    assert state(controller) == IS_NEW


def asked(controller: Controller, data: bytes) -> bytes:
    """The answer to one frame."""
    (answer,) = controller.push(data)
    return answer


def put(controller: Controller, slot: int, image: Image, version: int, chunks: int) -> None:
    """Open session 3, announce an image, and send so many of its chunks."""
    controller.push(protocol.open_frame(3))
    nu, ns = image.data[2:4]
    for data in protocol.begin_frames(3, slot, nu, ns, len(image.data), version, image.crc):
        controller.push(data)
    for k in range(chunks):
        controller.push(protocol.data_frame(3, k, image.data))


def is_active(controller: Controller, image: Image) -> bool:
    """Whether slot 0 gives the flows of this image, everywhere."""
    table = lookup.table_of(image.data)
    u = table.direction * table.w_v[1:, None].astype(float)
    q = controller.flow(0, u, table.dp_pa)[0]
    return bool(np.abs(q - table.flow(u, table.dp_pa)[0]).max() < 1e-5 * np.abs(q).max())


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


def test_a_session_has_a_number() -> None:
    assert asked(begun(), protocol.open_frame(0))[3] == Reason.FORMAT


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


def test_only_the_version_that_has_arrived_is_committed() -> None:
    controller = begun()
    put(controller, 0, NEW[0], 6, NEW[0].chunks)
    assert asked(controller, protocol.frame(3, Op.END, b"\0"))[3] == Reason.DONE
    assert asked(controller, protocol.commit_frame(3, [0], 7))[3] == Reason.VERSION
    assert asked(controller, protocol.commit_frame(3, [0, 1], 6))[3] == Reason.ORDER
    assert asked(controller, protocol.commit_frame(3, [], 6))[3] == Reason.ORDER
    assert asked(controller, protocol.commit_frame(3, [0, 9], 6))[3] == Reason.SLOT
    assert is_active(controller, OLD[0])
    assert asked(controller, protocol.commit_frame(3, [0], 6))[3] == Reason.DONE
    assert is_active(controller, NEW[0])


@pytest.mark.parametrize("chunks", [0, 1, 100, 249])
def test_what_was_whole_and_is_begun_again_is_not_whole(chunks: int) -> None:
    controller = begun()
    put(controller, 0, NEW[0], 6, NEW[0].chunks)
    assert asked(controller, protocol.frame(3, Op.END, b"\0"))[3] == Reason.DONE
    put(controller, 0, NEW[0], 6, chunks)
    assert asked(controller, protocol.commit_frame(3, [0], 6))[3] == Reason.ORDER
    assert asked(controller, protocol.frame(3, Op.END, b"\0"))[3] == Reason.INCOMPLETE
    assert state(controller) == IS_OLD and is_active(controller, OLD[0])


def test_a_session_that_was_closed_or_lost_leaves_nothing_behind() -> None:
    for new in (3, 4):
        controller = begun()
        put(controller, 0, NEW[0], 6, NEW[0].chunks)
        assert asked(controller, protocol.frame(3, Op.END, b"\0"))[3] == Reason.DONE
        if new == 3:
            controller.push(protocol.frame(3, Op.CLOSE))
        controller.now_ms += 5000
        controller.push(protocol.open_frame(new))
        assert asked(controller, protocol.commit_frame(new, [0], 6))[3] == Reason.ORDER
        assert is_active(controller, OLD[0])


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


def broken_images() -> list[bytes]:
    """Whole images, with a good CRC, that are no plausible map."""
    good = bytearray(lookup.image(a_table(6, 5), 0))
    found = []
    for at, data in (
        (0, b"\3"), (1, b"\1"), (2, b"\7"), (4, b"\2"), (8, b"\0\0\0\0"), (8, b"\0\0\xc0\x7f"),
        (8, b"\0\0\x80\x7f"), (12, b"\0\0\xc0\x7f"), (16, b"\0\0\xc0\x7f"),
        (20, bytes(good[16:20])), (16, b"\0\0\x80\xff"), (44, bytes(good[40:44])),
        (len(good) - 1, b"\5"), (len(good) - 20, b"\x85"), (62, b"\xff\x7f"),
    ):  # fmt: skip
        spoilt = bytearray(good)
        spoilt[at : at + len(data)] = data
        found.append(bytes(spoilt))
    return found


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


def whole(images: dict[int, Image], version: int, number: int) -> list[bytes]:
    """All frames of a download that nothing disturbs."""
    line = Line(Controller(2))
    session = Session(line, number)
    session.open()
    download(session, images, version)
    return line.sent


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


def run(frames: list[bytes]) -> bytes:
    stdin = b"".join(bytes([len(frame)]) + frame.ljust(8, b"\0") for frame in frames)
    done = subprocess.run([sanitised()], input=stdin, capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout


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
