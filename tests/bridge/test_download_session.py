"""Sessions of a map download: versions, confirmations, who may speak, and what is refused."""

from __future__ import annotations

import pytest

from firmware_bridge import lookup, protocol
from firmware_bridge.download import DownloadError, Image, Session, UnconfirmedError, download
from firmware_bridge.protocol import Op, Reason
from tests.bridge.controller import Line
from tests.bridge.downloads import IS_NEW, IS_OLD, NEW, OLD, asked, begun, is_active, put, state
from tests.bridge.tables import a_table


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


@pytest.mark.parametrize("version", [protocol.LAST_VERSION + 1, -1])
def test_a_version_that_no_frame_holds_is_told(version: int) -> None:
    controller = begun(protocol.LAST_VERSION)
    session = Session(Line(controller))
    session.open()
    assert session.held(0).version == protocol.LAST_VERSION
    with pytest.raises(protocol.FieldError, match=f"version {version} does not fit"):
        download(session, NEW, version)
    assert state(controller) == IS_OLD


@pytest.mark.parametrize(
    "fields",
    [(16, 1, 1, 4, 1, 1), (-1, 1, 1, 4, 1, 1), (0, 256, 1, 4, 1, 1), (0, 1, 1, 1 << 24, 1, 1)],
)
def test_a_number_beyond_its_field_is_told(fields: tuple[int, int, int, int, int, int]) -> None:
    if fields[0] == 16:
        with pytest.raises(protocol.FieldError, match="slots"):
            protocol.commit_frame(1, [fields[0]], 1)
        return
    with pytest.raises(protocol.FieldError, match="does not fit"):
        protocol.begin_frames(1, *fields)


def test_a_status_of_any_numbers_is_eight_bytes() -> None:
    told = protocol.status_frame(1, 2, 1000, -3, 100, 0, -1)
    assert protocol.is_whole(0, told) and list(told[2:5]) == [255, 0, 100]
    with pytest.raises(protocol.FieldError, match="chamber"):
        protocol.beta_frame(256, 8e8, 1e6)


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


def test_a_session_has_a_number() -> None:
    assert asked(begun(), protocol.open_frame(0))[3] == Reason.FORMAT


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
