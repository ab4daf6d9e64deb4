"""The frames of the map download, byte for byte as in c/rtid_download.h; `download.md` explains.

Every frame has eight bytes: an operation, six bytes, and the CRC-8 of `e2e` over the session's
number and the seven bytes before.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import isfinite

from firmware_bridge.e2e import TABLE

FORMAT = 1
SLOTS = 16
CHUNK = 6  # bytes of an image per frame
SEQUENCE = 128  # chunks are numbered modulo this
DATA = 0x80


class Op(IntEnum):
    """First byte of a frame: to the controller, its answers, and what rtid tells unasked."""

    OPEN = 0x01
    QUERY = 0x02
    BEGIN_SIZE = 0x03
    BEGIN_VERSION = 0x04
    BEGIN_CRC = 0x05
    POLL = 0x06
    END = 0x07
    COMMIT = 0x08
    CLOSE = 0x09
    ACCEPTS = 0x41
    REPLY = 0x42
    HELD_VERSION = 0x43
    HELD_CRC = 0x44
    STATUS = 0x61
    BETA = 0x62


class Reason(IntEnum):
    """What a REPLY says."""

    DONE = 0
    BUSY = 1
    FORMAT = 2
    SLOT = 3
    VERSION = 4
    SIZE = 5
    ORDER = 6
    INCOMPLETE = 7
    WRONG_CRC = 8
    CONTENT = 9
    LIMITS = 10
    NOT_NOW = 11


WORDS = {
    Reason.BUSY: ("another download is under way", "wait until it has ended (2 s of silence)"),
    Reason.FORMAT: ("it speaks another version of the protocol", "update rtid or the firmware"),
    Reason.SLOT: ("it has no such slot", "correct publish.slots in the project file"),
    Reason.VERSION: ("the version is not newer than the one it holds", "apply again"),
    Reason.SIZE: ("the map does not fit", "give it more room, or let publish.error_percent grow"),
    Reason.ORDER: ("frames were lost", "apply again"),
    Reason.INCOMPLETE: ("frames were lost", "apply again"),
    Reason.WRONG_CRC: ("what arrived is not what was sent", "look after the bus, apply again"),
    Reason.CONTENT: ("it takes the image for no plausible map", "report this: it is a defect"),
    Reason.LIMITS: ("the map is beyond the limits in its firmware", "are these maps of it?"),
    Reason.NOT_NOW: ("the machine is in no state to change maps", "apply again at standstill"),
}


@dataclass(frozen=True)
class Accepts:
    """What the controller has room for: slots, nodes of both axes together, flows."""

    format: int
    slots: int
    nodes: int
    counts: int


@dataclass(frozen=True)
class Held:
    """The active image of a slot; version 0: none."""

    version: int
    crc: int


def crc8(session: int, data: bytes) -> int:
    """CRC-8 of seven bytes in a session."""
    crc = int(TABLE[session & 0xFF])
    crc = int(TABLE[crc ^ session >> 8])
    for byte in data[:7]:
        crc = int(TABLE[crc ^ byte])
    return crc


def frame(session: int, op: int, body: bytes = b"") -> bytes:
    """Eight bytes; body: at most six."""
    data = bytes([op]) + body.ljust(CHUNK, b"\0")
    return data + bytes([crc8(session, data)])


def is_whole(session: int, data: bytes) -> bool:
    """Whether these are eight bytes with the session's CRC."""
    return len(data) == 8 and crc8(session, data) == data[7]


def open_frame(session: int) -> bytes:
    """Asks for a session: the only frame that belongs to none."""
    return frame(0, Op.OPEN, session.to_bytes(2, "little") + bytes([FORMAT]))


def begin_frames(
    session: int, slot: int, nu: int, ns: int, size: int, version: int, crc: int
) -> list[bytes]:
    """Announce an image of nu x ns nodes, size bytes."""
    head = bytes([slot, nu, ns]) + size.to_bytes(3, "little")
    return [
        frame(session, Op.BEGIN_SIZE, head),
        frame(session, Op.BEGIN_VERSION, bytes([slot]) + version.to_bytes(4, "little")),
        frame(session, Op.BEGIN_CRC, bytes([slot]) + crc.to_bytes(4, "little")),
    ]


def data_frame(session: int, chunk: int, image: bytes) -> bytes:
    """Chunk number `chunk` of the image."""
    return frame(session, DATA + chunk % SEQUENCE, image[chunk * CHUNK : (chunk + 1) * CHUNK])


def commit_frame(session: int, slots: list[int], version: int) -> bytes:
    """Make the images of these slots active, all at once."""
    mask = sum(1 << slot for slot in slots)
    return frame(session, Op.COMMIT, mask.to_bytes(2, "little") + version.to_bytes(4, "little"))


def status_frame(
    learning: int, verdict: int, alarms: int, progress: int, valid: int, flags: int, counter: int
) -> bytes:
    """How rtid is; see rtid_notice in c/rtid_download.h.  counter: taken modulo 256."""
    numbers = (learning | verdict << 4, alarms, progress, valid, flags)
    return frame(0, Op.STATUS, bytes([*(min(n, 255) for n in numbers), counter & 0xFF]))


def beta_frame(chamber: int, beta_pa: float, sd_pa: float) -> bytes:
    """Bulk modulus of a chamber and its standard deviation, each in bar; 0: not known."""
    known = (x if isfinite(x) else 0.0 for x in (beta_pa, sd_pa))
    words = b"".join(min(max(round(x * 1e-5), 0), 0xFFFF).to_bytes(2, "little") for x in known)
    return frame(0, Op.BETA, bytes([chamber]) + words)
