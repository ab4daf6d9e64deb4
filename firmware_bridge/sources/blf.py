"""BLF logs (Vector binary logging format), read in bulk.

A file is a header and a chain of objects; containers (type 10) hold zlib-compressed pieces of one
inner chain of objects, which may straddle containers.  Containers are inflated in parallel, then
one compiled pass walks the inner chain (`blf_objects`).  A damaged container is skipped and
counted; behind it the walk finds the next object by its signature.  Stamps are rounded to 1 us and
count from the start named in the header, which has 1 ms.
"""

from __future__ import annotations

import datetime
import itertools
import os
import re
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources.blf_objects import (
    BAD,
    BAD_CONTAINER,
    MIN_OBJECT,
    OTHER,
    REASONS,
    SIGNATURE,
    TRUNCATED,
    parse,
)
from firmware_bridge.sources.errors import LogError

OBJECT = struct.Struct("<4sHHLL")  # signature, header size, header version, object size, type
CONTAINER = struct.Struct("<H6xL4x")  # compression method, inflated size
CONTAINER_TYPE = 10
HEADER_BYTES = 144
STORED, DEFLATED = 0, 2
MAX_CONTAINER = 64 << 20  # inflated; python-can and Vector write 128 KiB
WRITE_BYTES = 128 << 10

# signature, header size 16, header version 1, any size, type 10, and room for its own head
CONTAINER_START = re.compile(rb"LOBJ\x10\x00\x01\x00.{4}\x0a\x00\x00\x00(?=.{16})", re.DOTALL)
PADDING = 3  # bytes at most behind a container

CAN_OBJECT = np.dtype(
    [
        ("signature", "S4"), ("header_size", "<u2"), ("header_version", "<u2"),
        ("size", "<u4"), ("type", "<u4"),
        ("flags", "<u4"), ("client", "<u2"), ("version", "<u2"), ("t_ns", "<u8"),
        ("channel", "<u2"), ("direction", "u1"), ("length", "u1"), ("can_id", "<u4"),
        ("data", "u1", 8),
    ]
)  # fmt: skip


class Piece(NamedTuple):
    """A container: method, stated size of its content, content, and whether the file cuts it."""

    method: int
    size: int
    packed: bytes
    is_cut: bool


class Content(NamedTuple):
    """What a container held, whether that is all of it, and what follows behind its end."""

    data: bytes
    is_whole: bool
    rest: bytes = b""


def _start_us(header: bytes) -> int:
    """Start of the log in microseconds since 1970; 0 if the header holds no valid date."""
    year, month, _, day, hour, minute, second, milli = struct.unpack_from("<8H", header, 40)
    try:
        start = datetime.datetime(
            year, month, day, hour, minute, second, milli * 1000, datetime.UTC
        )
    except ValueError:
        return 0
    return round(start.timestamp() * 1e3) * 1000


def _inflate(piece: Piece) -> Content:
    """What a container holds.

    zlib's checksum stands at the end of the stream: without it content is taken only where the
    file itself ends, because all bytes before a cut are good.
    """
    if piece.method == STORED:
        whole = len(piece.packed) == piece.size
        return Content(piece.packed if whole or piece.is_cut else b"", whole)
    engine = zlib.decompressobj()
    try:
        content = engine.decompress(piece.packed, MAX_CONTAINER)
    except zlib.error:
        return Content(b"", False)
    if not engine.eof:
        return Content(content if piece.is_cut else b"", False)
    return Content(content, True, engine.unused_data[PADDING:].strip(b"\0"))


def _containers(raw: bytes) -> list[Piece]:
    """All containers of a file.

    A deflated one reaches to the next one, whatever its own size field says: zlib knows its end.
    """
    places = [found.start() for found in CONTAINER_START.finditer(raw)]
    pieces = []
    for pos, stop in itertools.pairwise([*places, len(raw)]):
        end = pos + OBJECT.unpack_from(raw, pos)[3]
        method, size = CONTAINER.unpack_from(raw, pos + OBJECT.size)
        packed = raw[pos + OBJECT.size + CONTAINER.size : min(stop, end) if not method else stop]
        pieces.append(Piece(method, size, packed, stop == len(raw) and end > stop))
    return pieces


def _segments(
    contents: list[Content], is_cut: bool, counts: NDArray[np.int64]
) -> tuple[NDArray[np.uint8], list[int]]:
    """All content in one piece, and the borders that no object may cross; counts them.

    Between two containers lies nothing but padding, or a container whose head is damaged; behind
    the last one of a cut file, what is left of the next one.
    """
    borders, size = [0], 0
    for k, content in enumerate(contents, 1):
        size += len(content.data)
        if content.rest and not (is_cut and k == len(contents)):
            counts[OTHER if content.rest.startswith(SIGNATURE) else BAD_CONTAINER] += 1
        if content.rest or not content.is_whole:
            borders.append(size)
    if size > borders[-1]:
        borders.append(size)
    return np.frombuffer(b"".join([content.data for content in contents]), np.uint8), borders


def read(path: Path) -> Frames:
    """All classic data frames of a BLF file; LogError if it is none."""
    raw = path.read_bytes()
    pieces = _containers(raw)
    if len(raw) < HEADER_BYTES or (raw[:4] != b"LOGG" and not pieces):
        raise LogError(f"{path}: not a BLF file (no LOGG header); check the file or its suffix")
    counts = np.zeros(len(REASONS), np.int64)
    with ThreadPoolExecutor(2) as pool:  # zlib releases the interpreter lock
        contents = list(pool.map(_inflate, pieces))
    lost = [not (c.is_whole or p.is_cut) for p, c in zip(pieces, contents, strict=True)]
    counts[BAD_CONTAINER] += sum(lost)
    is_cut = _is_cut(raw, pieces)
    text, borders = _segments(contents, is_cut, counts)
    out = fr.empty(len(text) // MIN_OBJECT + 1)
    n, start_us = 0, _start_us(raw)
    for begin, end in itertools.pairwise(borders):
        counts[BAD] += counts[TRUNCATED]  # the object before this one ends in a lost container
        counts[TRUNCATED] = 0
        n = parse(
            text, begin, end, start_us, out.t_us, out.channel, out.can_id, out.length, out.data,
            n, counts,
        )  # fmt: skip
    if lost and lost[-1]:
        counts[BAD], counts[TRUNCATED] = counts[BAD] + counts[TRUNCATED], 0
    counts[TRUNCATED] = counts[TRUNCATED] > 0 or is_cut
    found = out[:n]
    fr.add_counts(found.refused, dict(zip(REASONS, counts.tolist(), strict=True)))
    return found


def _is_cut(raw: bytes, pieces: list[Piece]) -> bool:
    """Whether the file ends before its last container or before the size that its header says."""
    (size,) = struct.unpack_from("<Q", raw, 16)
    return size > len(raw) or not pieces or pieces[-1].is_cut


def write(path: Path, frames: Frames) -> None:
    """Write frames as a BLF file, in bulk; python-can and Vector tools read it."""
    with Writer(path, int(frames.t_us.min()) if len(frames) else 0) as log:
        log.write(frames)


class Writer:
    """A BLF file that grows: what was written is on its way to disk after each `write`.

    A file that nobody closed is read up to its last container, and counted as truncated.
    start_us: stamps count from here; its year must lie after 1990 to be kept.
    """

    def __init__(self, path: Path, start_us: int) -> None:
        self._start_ms = self._stop_ms = start_us // 1000
        self._file_bytes = self._content_bytes = HEADER_BYTES
        self._objects = 0
        self._file = path.open("wb", buffering=0)
        self._write_header()

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file_bytes

    def write(self, frames: Frames) -> None:
        """Append frames, of at least the start's time; OSError where the disk takes no more."""
        if not len(frames):
            return
        content = _inner(frames, self._start_ms).tobytes()
        parts = [content[k : k + WRITE_BYTES] for k in range(0, len(content), WRITE_BYTES)]
        packed = b"".join(map(_container, parts))
        self._file.write(packed)
        self._file_bytes += len(packed)
        self._content_bytes += len(content) + 32 * len(parts)
        self._objects += len(frames)
        self._stop_ms = max(self._stop_ms, int(frames.t_us.max()) // 1000)
        self._write_header()

    def close(self) -> None:
        """Release the file; harmless when called again."""
        self._file.close()

    def _write_header(self) -> None:
        sizes = self._file_bytes, self._content_bytes
        self._file.seek(0)
        self._file.write(_header(sizes, self._objects, self._start_ms, self._stop_ms))
        self._file.seek(0, os.SEEK_END)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _inner(frames: Frames, start_ms: int) -> NDArray[np.void]:
    """The frames as objects of the inner chain."""
    objects = np.zeros(len(frames), CAN_OBJECT)
    objects["signature"], objects["header_size"], objects["header_version"] = SIGNATURE, 32, 1
    objects["size"], objects["type"], objects["flags"] = CAN_OBJECT.itemsize, 86, 2
    objects["t_ns"] = (frames.t_us - start_ms * 1000) * 1000
    objects["channel"] = frames.channel.astype(np.uint16) + 1
    objects["length"], objects["can_id"] = frames.length, frames.can_id
    objects["data"] = frames.data
    return objects


def _container(content: bytes) -> bytes:
    packed = zlib.compress(content, 1)
    size = OBJECT.size + CONTAINER.size + len(packed)
    head = OBJECT.pack(SIGNATURE, OBJECT.size, 1, size, CONTAINER_TYPE)
    return head + CONTAINER.pack(DEFLATED, len(content)) + packed + bytes(size % 4)


def _header(sizes: tuple[int, int], n_objects: int, start_ms: int, stop_ms: int) -> bytes:
    head = struct.pack(
        "<4sL8BQQLL", b"LOGG", HEADER_BYTES, 5, 0, 0, 0, 2, 6, 8, 1, *sizes, n_objects, 0
    )
    return (head + _system_time(start_ms) + _system_time(stop_ms)).ljust(HEADER_BYTES, b"\0")


def _system_time(t_ms: int) -> bytes:
    t = datetime.datetime.fromtimestamp(t_ms // 1000, datetime.UTC)
    return struct.pack(
        "<8H", t.year, t.month, t.isoweekday() % 7, t.day, t.hour, t.minute, t.second, t_ms % 1000
    )
