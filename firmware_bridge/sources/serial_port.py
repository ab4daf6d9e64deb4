"""Frames over a serial line: COBS with CRC-16.

On the wire: COBS(body + CRC), then 0x00.  The body is little-endian: can_id (4 bytes, bit 31 for
a 29 bit identifier), t_us (8 bytes, clock of the controller), payload (0 to 8 bytes).  The CRC is
CRC-16 CCITT over the body (binascii.crc_hqx, start value 0xFFFF), high byte first.
0x00 occurs nowhere else, so after any damage the reader is in step again at the next 0x00.
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
from firmware_bridge.sources.live import POLL_S, LiveSource, SourceError

BODY = struct.Struct("<IQ")
MAX_BLOCK = BODY.size + 8 + 2  # body, payload, CRC: below 254, so COBS needs one byte more
MAX_PENDING = 4096  # bytes kept while no 0x00 comes
CRC_START = 0xFFFF

_CRC = np.array([binascii.crc_hqx(bytes([k]), 0) for k in range(256)], np.uint16)


def encode(frames: Frames) -> bytes:
    """The bytes that send these frames; the channel is not transmitted."""
    out = bytearray()
    for k in range(len(frames)):
        body = BODY.pack(int(frames.can_id[k]), int(frames.t_us[k]))
        body += frames.data[k, : frames.length[k]].tobytes()
        out += cobs.encode(body + binascii.crc_hqx(body, CRC_START).to_bytes(2, "big")) + b"\0"
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
    return bool(crc == np.int64(block[n - 2]) * 256 + np.int64(block[n - 1]))


@kernel
def parse(
    text: NDArray[np.uint8],
    t_us: NDArray[np.int64],
    can_id: NDArray[np.uint32],
    length: NDArray[np.uint8],
    data: NDArray[np.uint8],
    block: NDArray[np.uint8],
) -> tuple[Integer, Integer, Integer]:
    """Frames found, bytes used and bad blocks in text; the arrays are changed in place."""
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
        number, stamp = np.uint32(0), np.int64(0)
        for k in range(4):
            number |= np.uint32(block[k]) << np.uint32(8 * k)
        for k in range(8):
            stamp |= np.int64(block[4 + k]) << (8 * k)
        t_us[n], can_id[n], length[n] = stamp, number, size - 14
        data[n] = 0
        data[n, : size - 14] = block[12 : size - 2]
        n += 1
    return n, start, bad


class Decoder:
    """Turns pieces of the byte stream into frames; a frame may be cut anywhere."""

    def __init__(self) -> None:
        self._pending = b""
        self._block = np.zeros(MAX_BLOCK + 2, np.uint8)

    def push(self, piece: bytes) -> Frames:
        """The frames that became complete; `refused` counts "bad_serial_frame"."""
        text = self._pending + piece
        out = fr.empty(text.count(0))
        n, used, bad = parse(
            np.frombuffer(text, np.uint8), out.t_us, out.can_id, out.length, out.data, self._block
        )
        self._pending = text[used:]
        if len(self._pending) > MAX_PENDING:
            self._pending, bad = b"\x01", bad + 1  # what follows up to 0x00 cannot be a frame
        found = out[:n]
        fr.add_counts(found.refused, {"bad_serial_frame": bad})
        return found


class SerialPort(LiveSource[bytes]):
    """Frames from a serial port (or a pty); raises SourceError if it cannot be opened."""

    def __init__(self, port: str, baudrate: int = 2_000_000) -> None:
        super().__init__()
        self._decoder = Decoder()
        try:
            self._line = serial.Serial(port, baudrate, timeout=POLL_S)
        except (serial.SerialException, ValueError) as error:
            raise SourceError(f"cannot open serial port {port}: {error}") from error

    def _receive(self) -> bytes | None:
        piece: bytes = self._line.read(max(1, self._line.in_waiting))
        return piece or None

    def _convert(self, items: list[bytes]) -> Frames:
        return self._decoder.push(b"".join(items))

    def _close(self) -> None:
        self._line.close()
