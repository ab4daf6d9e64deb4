"""What tests of the map download share: images, lines that spoil, a controller that holds maps."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from random import Random

import numpy as np

from firmware_bridge import lookup, protocol
from firmware_bridge.download import Image, Session, download
from tests.bridge.controller import Controller, Line, sanitised
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


def whole(images: dict[int, Image], version: int, number: int) -> list[bytes]:
    """All frames of a download that nothing disturbs."""
    line = Line(Controller(2))
    session = Session(line, number)
    session.open()
    download(session, images, version)
    return line.sent


def run(frames: list[bytes]) -> bytes:
    stdin = b"".join(bytes([len(frame)]) + frame.ljust(8, b"\0") for frame in frames)
    done = subprocess.run([sanitised()], input=stdin, capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout
