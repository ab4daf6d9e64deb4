"""Frames over a serial line: COBS with CRC-16.

On the wire: 0x00, COBS(body + CRC), 0x00.  The body is little-endian: can_id (4 bytes, bit 31 for
a 29 bit identifier), t_us (8 bytes, clock of the controller), payload (0 to 8 bytes).  The CRC is
CRC-16 CCITT over the body (binascii.crc_hqx, start value 0xFFFF), inverted, high byte first: not
inverted, a CRC that ends in 0x00 would not notice the loss of that byte (1 frame in 256).
0x00 occurs nowhere else, so after any damage the reader is in step again at the next 0x00; with one
before and one behind each frame no single bad byte can join two frames.  Of damaged frames the CRC
lets 2^-16 through, the rest is refused also for an identifier or a time that cannot be.
"""

from __future__ import annotations

import binascii
import struct

import numpy as np
import serial
from cobs import cobs
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, inlined, kernel
from firmware_bridge.sources.live import now_us
from firmware_bridge.sources.port import PortSource
from firmware_bridge.stamps import StampModel
from firmware_bridge.steps import Continuous

BAUDRATE = 2_000_000
BODY = struct.Struct("<IQ")
MAX_BLOCK = BODY.size + 8 + 2  # body, payload, CRC: below 254, so COBS needs one byte more
MAX_PENDING = 4096  # bytes kept while no 0x00 comes
TIME_BITS = 53  # 285 years
CRC_START = 0xFFFF

_CRC = np.array([binascii.crc_hqx(bytes([k]), 0) for k in range(256)], np.uint16)


def encode(frames: Frames) -> bytes:
    """The bytes that send these frames; the channel is not transmitted."""
    out = bytearray()
    for k in range(len(frames)):
        body = BODY.pack(int(frames.can_id[k]), int(frames.t_us[k]))
        body += frames.data[k, : frames.length[k]].tobytes()
        crc = binascii.crc_hqx(body, CRC_START) ^ 0xFFFF
        out += b"\0" + cobs.encode(body + crc.to_bytes(2, "big")) + b"\0"
    return bytes(out)


@inlined
def _uncobs(
    text: NDArray[np.uint8], pos: Integer, end: Integer, block: NDArray[np.uint8]
) -> Integer:
    """Decode text[pos:end] into block (changed in place); its length, -1 if malformed."""
    n = 0
    while pos < end:
        run = np.int64(text[pos])
        if pos + run > end or n + run > MAX_BLOCK + 1:
            return -1
        for k in range(1, run):
            block[n] = text[pos + k]
            n += 1
        pos += run
        if pos < end:
            block[n] = 0
            n += 1
    return n


@inlined
def _intact(block: NDArray[np.uint8], n: Integer) -> bool:
    """Whether the last two of n bytes are the CRC of those before."""
    crc = np.int64(CRC_START)
    for k in range(n - 2):
        crc = ((crc << 8) & 0xFFFF) ^ np.int64(_CRC[(crc >> 8) ^ np.int64(block[k])])
    return bool(crc ^ 0xFFFF == np.int64(block[n - 2]) * 256 + np.int64(block[n - 1]))


@inlined
def _number(block: NDArray[np.uint8], first: Integer, count: Integer) -> Integer:
    """Little-endian number of `count` bytes."""
    number = np.int64(0)
    for k in range(count):
        number |= np.int64(block[first + k]) << (8 * k)
    return number


@inlined
def _possible(can_id: Integer, t_us: Integer) -> bool:
    """Whether there is such an identifier and such a time."""
    first, bits = (fr.EXTENDED, 29) if can_id >= fr.EXTENDED else (0, 11)
    return bool(can_id - first < 1 << bits and 0 <= t_us < 1 << TIME_BITS)


@kernel
def parse(
    text: NDArray[np.uint8],
    t_us: NDArray[np.int64],
    can_id: NDArray[np.uint32],
    length: NDArray[np.uint8],
    data: NDArray[np.uint8],
    ends: NDArray[np.int64],
    block: NDArray[np.uint8],
) -> tuple[Integer, Integer, Integer]:
    """Frames found, bytes used and bad blocks in text; the arrays are changed in place.

    text (bytes,); the columns of `Frames` with ends (frames,); block (bytes,): scratch.
    """
    n, bad, start = 0, 0, 0
    for end in range(len(text)):
        if text[end] != 0:
            continue
        size = _uncobs(text, start, end, block)
        empty, start = end == start, end + 1
        if empty:
            continue
        if size < 14 or size > MAX_BLOCK or not _intact(block, size):
            bad += 1
            continue
        number, stamp = _number(block, 0, 4), _number(block, 4, 8)
        if not _possible(number, stamp):
            bad += 1
            continue
        t_us[n], can_id[n], length[n], ends[n] = stamp, number, size - 14, start
        data[n] = 0
        for j in range(size - 14):
            data[n, j] = block[12 + j]
        n += 1
    return n, start, bad


class Decoder:
    """Turns pieces of the byte stream into frames; a frame may be cut anywhere."""

    def __init__(self) -> None:
        self._pending = b""
        self._block = np.zeros(MAX_BLOCK + 2, np.uint8)

    def push(self, piece: bytes) -> Frames:
        """The frames that became complete; `refused` counts "bad_serial_frame"."""
        return self.decode(piece)[0]

    def decode(self, piece: bytes) -> tuple[Frames, NDArray[np.int64]]:
        """As `push`; and behind which byte of the piece each frame was complete, int64 (n,)."""
        kept, text = len(self._pending), self._pending + piece
        out, ends = fr.empty(text.count(0)), np.empty(text.count(0), np.int64)
        n, used, bad = parse(
            np.frombuffer(text, np.uint8),
            out.t_us, out.can_id, out.length, out.data, ends, self._block,
        )  # fmt: skip
        # What is longer cannot become a frame: its beginning is refused at the next 0x00.
        self._pending = text[used : used + MAX_PENDING]
        frames = out[:n]
        fr.add_counts(frames.refused, {"bad_serial_frame": bad})
        return frames, ends[:n] - kept


class SerialPort(PortSource):
    """Frames from a serial port, stamped by the controller.

    The controller's stamps stay as they are (see `steps.Continuous`); with host_time they are
    mapped to the clock of this machine (`stamps.StampModel`), as several controllers need it.
    """

    def __init__(
        self,
        port: str,
        baudrate: int = BAUDRATE,
        *,
        host_time: bool = False,
        reopen_s: float = 0.0,
    ) -> None:
        self._decoder = Decoder()
        self._own, self._model = Continuous(), StampModel() if host_time else None
        super().__init__(port, baudrate, reopen_s)

    def _greet(self, line: serial.Serial) -> None:
        """The controller speaks unasked."""

    def _decode(self, stream: bytes) -> tuple[Frames, NDArray[np.int64]]:
        return self._decoder.decode(stream)

    def _timed(self, frames: Frames, arrived_us: NDArray[np.int64]) -> Frames:
        if self._model is None:
            return self._own.push(frames)
        return self._model.push(frames, arrived_us)

    def _seam(self) -> tuple[int, bytes]:
        return now_us(), b"\0"  # ends what was cut
