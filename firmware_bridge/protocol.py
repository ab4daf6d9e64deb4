"""The frames of the map download, byte for byte as in c/rtid_download.h; `download.md` explains.

Every frame has eight bytes: an operation, six bytes, and the CRC-8 of `e2e` over the session's
number and the seven bytes before.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from math import isfinite

from firmware_bridge.e2e import TABLE

FORMAT = 1
SLOTS = 16
CHUNK = 6  # bytes of an image per frame
SEQUENCE = 128  # chunks are numbered modulo this
PROBES = 16  # questions for a flow are numbered modulo this
DATA = 0x80
LAST_VERSION = 0xFFFF_FFFF  # no map can be newer


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
    PROBE_COMMAND = 0x0A
    PROBE_DROP = 0x0B
    ACCEPTS = 0x41
    REPLY = 0x42
    HELD_VERSION = 0x43
    HELD_CRC = 0x44
    FLOW = 0x45
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


class FieldError(ValueError):
    """A number that its field of a frame does not hold; `remedy` says what to do."""

    exit_code = 3
    remedy = "nothing was sent with it; the controller's maps are as before"


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


def _field(value: int, size: int, what: str) -> bytes:
    """A number as it stands in a frame, in so many bytes.  Raises FieldError."""
    if not 0 <= value < 1 << 8 * size:
        raise FieldError(f"{what} {value} does not fit into {size} bytes of a frame")
    return value.to_bytes(size, "little")


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
    return frame(0, Op.OPEN, _field(session, 2, "session") + bytes([FORMAT]))


def begin_frames(
    session: int, slot: int, nu: int, ns: int, size: int, version: int, crc: int
) -> list[bytes]:
    """Announce an image of nu x ns nodes, size bytes.  Raises FieldError, as all frames do."""
    at = _field(slot, 1, "slot")
    nodes = _field(nu, 1, "nodes") + _field(ns, 1, "nodes")
    return [
        frame(session, Op.BEGIN_SIZE, at + nodes + _field(size, 3, "image size")),
        frame(session, Op.BEGIN_VERSION, at + _field(version, 4, "version")),
        frame(session, Op.BEGIN_CRC, at + _field(crc, 4, "CRC")),
    ]


def data_frame(session: int, chunk: int, image: bytes) -> bytes:
    """Chunk number `chunk` of the image."""
    return frame(session, DATA + chunk % SEQUENCE, image[chunk * CHUNK : (chunk + 1) * CHUNK])


def commit_frame(session: int, slots: list[int], version: int) -> bytes:
    """Make the images of these slots active, all at once."""
    mask = sum(1 << slot for slot in slots)
    return frame(session, Op.COMMIT, _field(mask, 2, "slots") + _field(version, 4, "version"))


def probe_frames(session: int, slot: int, number: int, u_v: float, dp_pa: float) -> list[bytes]:
    """Ask, as question `number`, what a slot's active map gives at a command and a pressure drop.

    Of a slot with numbers u_v is the index of one, and dp_pa counts for nothing.
    """
    at, count = _field(slot, 1, "slot"), bytes([number % PROBES])
    return [
        frame(session, Op.PROBE_COMMAND, at + struct.pack("<f", u_v) + count),
        frame(session, Op.PROBE_DROP, at + struct.pack("<f", dp_pa) + count),
    ]


def flow_of(answer: bytes) -> tuple[float, int]:
    """The flow of a FLOW answer, m3/s, and what it stands on (`lookup.STATUS`)."""
    return struct.unpack_from("<f", answer, 2)[0], answer[6] % PROBES


def status_frame(
    learning: int, verdict: int, alarms: int, progress: int, valid: int, flags: int, counter: int
) -> bytes:
    """How rtid is; see rtid_notice in c/rtid_download.h.  counter: taken modulo 256."""
    numbers = (learning | verdict << 4, alarms, progress, valid, flags)
    numbers_of = (min(max(n, 0), 255) for n in numbers)
    return frame(0, Op.STATUS, bytes([*numbers_of, counter & 0xFF]))


def beta_frame(chamber: int, beta_pa: float, sd_pa: float) -> bytes:
    """Bulk modulus of a chamber and its standard deviation, each in bar; 0: not known."""
    known = (x if isfinite(x) else 0.0 for x in (beta_pa, sd_pa))
    words = b"".join(min(max(round(x * 1e-5), 0), 0xFFFF).to_bytes(2, "little") for x in known)
    return frame(0, Op.BETA, _field(chamber, 1, "chamber") + words)
