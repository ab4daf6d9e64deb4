"""The map download over lines that lose, repeat, swap and damage; no half map is ever active."""

from __future__ import annotations

import contextlib
from random import Random

import numpy as np
import pytest

from firmware_bridge import protocol
from firmware_bridge.download import DownloadError, Session, download
from firmware_bridge.protocol import Op
from tests.bridge.controller import Controller, Line
from tests.bridge.downloads import IS_NEW, IS_OLD, NEW, SPOILS, begun, losing, state


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
