"""Controllers that lie, each answer of the protocol in turn: no "done" that is not true."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest

from firmware_bridge import protocol
from firmware_bridge.download import Image, Session, download
from firmware_bridge.lookup import crc32, numbers_of, table_of
from firmware_bridge.protocol import Op, Reason
from rtid.apply import reach
from rtid.apply.versions import CONTRADICTED, DONE, UNCONFIRMED, UNVERIFIED, Applied, VersionRow
from rtid.cli.exits import Exit
from rtid.project import load
from tests.apply.neighbour import learned, offer, project_file
from tests.bridge.controller import Controller, Line
from tests.command import ends

SLOTS = range(5)
Lie = Callable[["Liar", bytes], bytes | None]  # an answer, and what is said in its place


@dataclass
class Liar:
    """A controller whose answers pass through `lie`; `deaf` to these frames, which it acknowledges.

    wanted: what it is sent, so that it can pretend to hold it.
    """

    controller: Controller
    lie: Lie = lambda liar, answer: answer
    deaf: tuple[int, ...] = ()
    wanted: dict[int, dict[int, bytes]] = field(default_factory=dict)
    session: int = 0
    committed: bool = False

    def spoil(self, data: bytes, is_answer: bool) -> list[bytes]:
        """What arrives in place of one frame."""
        if not is_answer:
            return self._listen(data)
        said = self.lie(self, data)
        return [] if said is None else [self.signed(said)]

    def signed(self, body: bytes) -> bytes:
        """The same with the CRC of the session: no lie is found out by that."""
        return body[:7] + bytes([protocol.crc8(self.session, body)])

    def _listen(self, data: bytes) -> list[bytes]:
        if data[0] == Op.OPEN:
            self.session = int.from_bytes(data[1:3], "little")
        if data[0] in (Op.BEGIN_VERSION, Op.BEGIN_CRC):
            self.wanted.setdefault(data[1], {})[data[0]] = data[2:6]
        self.committed |= data[0] == Op.COMMIT
        if data[0] not in self.deaf:
            return [data]
        poll = bytes([Op.POLL, 0])  # answered with a REPLY, which is then said to be of this frame
        return [self.signed(poll + bytes(6))]


def put(at: int, value: bytes) -> Callable[[bytes], bytes]:
    return lambda answer: answer[:at] + value + answer[at + len(value) :]


def always(op: int, change: Callable[[bytes], bytes]) -> Lie:
    return lambda liar, answer: change(answer) if answer[0] == op else answer


def after(op: int, change: Callable[[bytes], bytes]) -> Lie:
    """Honest until the order to change maps."""
    return lambda liar, answer: change(answer) if answer[0] == op and liar.committed else answer


def reply(asked: int, reason: Reason) -> Lie:
    return lambda liar, answer: (
        put(3, bytes([reason]))(answer) if answer[0] == Op.REPLY and answer[1] == asked else answer
    )


def next_chunk(chunk: int) -> Lie:
    return lambda liar, answer: (
        put(4, chunk.to_bytes(2, "little"))(answer)
        if answer[:2] == bytes([Op.REPLY, Op.POLL])
        else answer
    )


def silent(op: int) -> Lie:
    return lambda liar, answer: None if answer[0] == op else answer


def pretends(liar: Liar, answer: bytes) -> bytes:
    """Says that it holds what it was sent, and has done what it was told."""
    asked = {Op.HELD_VERSION: Op.BEGIN_VERSION, Op.HELD_CRC: Op.BEGIN_CRC}.get(Op(answer[0]))
    if asked is not None and liar.committed:
        return put(2, liar.wanted[answer[1]][asked])(answer)
    if answer[0] == Op.REPLY:
        op = Op.COMMIT if liar.committed else answer[1]
        return bytes([Op.REPLY, op, answer[2], Reason.DONE]) + answer[4:]
    return answer


def times(factor: float) -> Callable[[bytes], bytes]:
    def change(answer: bytes) -> bytes:
        (flow,) = struct.unpack_from("<f", answer, 2)
        return put(2, struct.pack("<f", factor * flow))(answer)

    return change


def flow_is(value: float) -> Callable[[bytes], bytes]:
    return put(2, struct.pack("<f", value))


LIES: dict[str, tuple[Lie, tuple[int, ...]]] = {
    "accepts: format": (always(Op.ACCEPTS, put(1, b"\2")), ()),
    "accepts: no slot": (always(Op.ACCEPTS, put(2, b"\0")), ()),
    "accepts: too few slots": (always(Op.ACCEPTS, put(2, b"\4")), ()),
    "accepts: too many slots": (always(Op.ACCEPTS, put(2, b"\xff")), ()),
    "accepts: no nodes": (always(Op.ACCEPTS, put(3, b"\0\0")), ()),
    "accepts: too many nodes": (always(Op.ACCEPTS, put(3, b"\xff\xff")), ()),
    "accepts: no flows": (always(Op.ACCEPTS, put(5, b"\0\0")), ()),
    "held version: none": (always(Op.HELD_VERSION, put(2, bytes(4))), ()),
    "held version: 7": (always(Op.HELD_VERSION, put(2, b"\7\0\0\0")), ()),
    "held version: the last": (always(Op.HELD_VERSION, put(2, b"\xff" * 4)), ()),
    "held version: of another slot": (always(Op.HELD_VERSION, put(1, b"\1")), ()),
    "held version after: none": (after(Op.HELD_VERSION, put(2, bytes(4))), ()),
    "held version after: 9": (after(Op.HELD_VERSION, put(2, b"\x09\0\0\0")), ()),
    "held version: silent": (silent(Op.HELD_VERSION), ()),
    "held crc: 0": (always(Op.HELD_CRC, put(2, bytes(4))), ()),
    "held crc: another": (always(Op.HELD_CRC, put(3, b"\x5a")), ()),
    "held crc after: another": (after(Op.HELD_CRC, put(3, b"\x5a")), ()),
    "held crc: of another slot": (always(Op.HELD_CRC, put(1, b"\2")), ()),
    "held crc: silent": (silent(Op.HELD_CRC), ()),
    **{
        f"reply to {op.name}: {reason.name}": (reply(op, reason), ())
        for op in (Op.BEGIN_CRC, Op.POLL, Op.END, Op.COMMIT)
        for reason in (Reason.BUSY, Reason.VERSION, Reason.ORDER, Reason.WRONG_CRC, Reason.NOT_NOW)
    },
    "reply: an unknown reason": (reply(Op.COMMIT, 77), ()),  # type: ignore[arg-type]
    "poll: all is here": (next_chunk(0xFFFF), ()),
    "poll: nothing is here": (next_chunk(0), ()),
    "poll: ten chunks": (next_chunk(10), ()),
    "close: refused": (reply(Op.CLOSE, Reason.NOT_NOW), ()),
    "deaf to commit, says done": (pretends, (Op.COMMIT,)),
    "deaf to commit, says done, holds what it held": (
        lambda liar, a: pretends(liar, a) if a[0] == Op.REPLY else a, (Op.COMMIT,)
    ),
    "deaf to commit, says no word": (lambda liar, a: a, (Op.COMMIT,)),
    "deaf to end, says done": (reply(Op.END, Reason.DONE), (Op.END,)),
    "keeps nothing, says done to all": (
        pretends, (Op.BEGIN_SIZE, Op.BEGIN_VERSION, Op.BEGIN_CRC, Op.END, Op.COMMIT),
    ),
    "flow: 0": (always(Op.FLOW, flow_is(0.0)), ()),
    "flow: nan": (always(Op.FLOW, flow_is(float("nan"))), ()),
    "flow: inf": (always(Op.FLOW, flow_is(float("inf"))), ()),
    "flow: 1 % more": (always(Op.FLOW, times(1.01)), ()),
    "flow: reversed": (always(Op.FLOW, times(-1.0)), ()),
    "flow: stands on nothing": (always(Op.FLOW, lambda a: put(6, bytes([a[6] | 6]))(a)), ()),
    "flow: of another slot": (always(Op.FLOW, put(1, b"\3")), ()),
    "flow: of another question": (always(Op.FLOW, lambda a: put(6, bytes([a[6] ^ 0x10]))(a)), ()),
    "flow: silent": (silent(Op.FLOW), ()),
}  # fmt: skip


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[int, dict[int, bytes]]]:
    """A folder from which two maps were sent, in good faith; the images of both."""
    folder = tmp_path_factory.mktemp("sent")
    path, state = project_file(folder, error_percent=5), folder / "cylinder.state"
    project, controller = load(path), Controller()
    with pytest.MonkeyPatch.context() as patch:
        for k, factor in enumerate((1.0, 1.02)):
            offer(state, project, learned(project, 0, factor), against=k or None)
            assert command(patch, path, Liar(controller))[0] == Exit.OK
    applied = Applied(state)
    return folder, {version: applied.images(version) for version in (1, 2)}


@pytest.fixture
def copied(
    before: tuple[Path, dict[int, dict[int, bytes]]], tmp_path: Path
) -> tuple[Path, dict[int, dict[int, bytes]]]:
    """The project file in a copy of that folder, and the images of both maps."""
    sent, images = before
    return copytree(sent, tmp_path / "project") / "cylinder.toml", images


def command(patch: pytest.MonkeyPatch, path: Path, liar: Liar, *words: str) -> tuple[int, Line]:
    """`rtid apply` over a line to the liar, in made-up time; its exit code."""
    line = Line(liar.controller, liar.spoil)

    @contextmanager
    def armed(*_: Any) -> Iterator[Line]:
        yield line

    patch.setattr(reach, "armed", armed)
    call = ("apply", path, "--bus", "virtual:none", "--test-bus", "--yes", "--json", *words)
    return ends(*call), line


def holding(images: dict[int, bytes], version: int) -> Controller:
    """A controller with these maps."""
    controller = Controller()
    session = Session(Line(controller))
    session.open()
    download(session, {slot: Image(data) for slot, data in images.items()}, version)
    session.close()
    return controller


def gives(controller: Controller, images: dict[int, bytes]) -> bool:
    """Whether the firmware evaluates these images, everywhere."""
    for slot, data in images.items():
        if slot == SLOTS[-1]:
            if not np.allclose(controller.numbers(slot), numbers_of(data), rtol=1e-6):
                return False
            continue
        table = table_of(data)
        u = table.direction * table.w_v[1:, None].astype(float)
        off = controller.flow(slot, u, table.dp_pa)[0] - table.flow(u, table.dp_pa)[0]
        if np.abs(off).max() > 1e-5 * np.abs(table.flow_m3s).max():
            return False
    return True


def is_true(controller: Controller, row: VersionRow, images: dict[int, bytes]) -> bool:
    """Whether what the row says is what the firmware has."""
    is_held = all(controller.held(s) == (row.version, crc32(d)) for s, d in images.items())
    return is_held and gives(controller, images)


def test_there_are_fifty_lies() -> None:
    assert len(LIES) >= 50


@pytest.mark.parametrize("name", LIES)
def test_no_done_that_is_not_true(
    name: str,
    copied: tuple[Path, dict[int, dict[int, bytes]]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, images = copied
    lie, deaf = LIES[name]
    liar = Liar(holding(images[1], 1), lie, deaf)
    capsys.readouterr()
    code, _ = command(monkeypatch, path, liar, "--again", "--replace-unknown")
    told = capsys.readouterr()
    rows = Applied(path.with_suffix(".state")).rows()[2:]
    done = [row for row in rows if row.outcome == DONE]
    assert all(is_true(liar.controller, row, images[2]) for row in done), rows
    if code == Exit.OK:
        assert done, told.out
        assert json.loads(told.out)["applied"]["outcome"] == DONE
    else:
        assert "Traceback" not in told.err and (told.err or not done), told


def test_an_old_receiver_is_not_verified(
    copied: tuple[Path, dict[int, dict[int, bytes]]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It does not know the question for a flow, and is silent: what it says is all there is."""
    path, images = copied
    liar = Liar(holding(images[1], 1), silent(Op.FLOW))
    capsys.readouterr()
    assert command(monkeypatch, path, liar, "--again")[0] == Exit.NEGATIVE
    told = json.loads(capsys.readouterr().out)["applied"]
    assert told["outcome"] == UNVERIFIED and told["verified"] == {"slots": 5, "points": 0}
    assert gives(liar.controller, images[2])
    assert command(monkeypatch, path, liar, "--again")[0] == Exit.OK  # the same: nothing is sent
    assert json.loads(capsys.readouterr().out)["verified"]["points"] == 0
    assert command(monkeypatch, path, liar, "--undo")[0] == Exit.NEGATIVE
    assert gives(liar.controller, images[1]), "undo knows what was sent, verified or not"
    outcomes = [row.outcome for row in Applied(path.with_suffix(".state")).rows()]
    assert outcomes == [DONE, DONE, UNVERIFIED, UNVERIFIED]


def test_an_order_that_was_not_confirmed_is_verified_before_it_is_settled(
    copied: tuple[Path, dict[int, dict[int, bytes]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, images = copied

    def lost(liar: Liar, answer: bytes) -> bytes | None:
        if answer[:2] == bytes([Op.REPLY, Op.POLL]) and liar.committed:
            return None
        return pretends(liar, answer)

    liar = Liar(holding(images[1], 1), lost, (Op.COMMIT,))
    assert command(monkeypatch, path, liar, "--again")[0] == Exit.INPUT
    liar.lie = pretends  # it says now that it has the maps, and it has not
    assert command(monkeypatch, path, liar, "--again")[0] == Exit.INPUT
    assert not gives(liar.controller, images[2])
    outcomes = [row.outcome for row in Applied(path.with_suffix(".state")).rows()]
    assert DONE not in outcomes[2:] and outcomes[2] == UNCONFIRMED


def test_the_reason_stands_in_the_records(
    copied: tuple[Path, dict[int, dict[int, bytes]]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, images = copied
    liar = Liar(holding(images[1], 1), pretends, (Op.COMMIT,))
    code, _ = command(monkeypatch, path, liar, "--again")
    told = capsys.readouterr().err
    assert code == Exit.INPUT
    assert "said done, but slot 0 gives" in told and "what was sent gives" in told
    assert Applied(path.with_suffix(".state")).rows()[-1].outcome == CONTRADICTED
