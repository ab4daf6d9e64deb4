"""BLF logs (Vector binary logging format), read in bulk.

A file is a header and a chain of objects; containers (type 10) hold zlib-compressed pieces of one
inner chain of objects, which may straddle containers.  Containers are inflated in parallel, then
one compiled pass walks the inner chain (`blf_objects`).  A damaged container is skipped and
counted; behind it the walk finds the next object by its signature.  Stamps are rounded to 1 us and
count from the start named in the header, which has 1 ms.
"""

from __future__ import annotations

import datetime
import errno
import itertools
import os
import re
import struct
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.sources.blf_objects import (
    BAD,
    BAD_CONTAINER,
    CAN_FD_MESSAGE,
    FD,
    MIN_OBJECT,
    OTHER,
    REASONS,
    SIGNATURE,
    TRUNCATED,
    parse,
)
from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.unpacked import Budget

OBJECT = struct.Struct("<4sHHLL")  # signature, header size, header version, object size, type
CONTAINER = struct.Struct("<H6xL4x")  # compression method, inflated size
CONTAINER_TYPE = 10
HEADER_BYTES = 144
STORED, DEFLATED = 0, 2
MAX_CONTAINER = 16 << 20  # inflated; python-can and Vector write 128 KiB
AT_ONCE = 4  # containers that are inflated together
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
FD_OBJECT = np.dtype(
    [
        *CAN_OBJECT.descr[:-4],
        ("flags_of_frame", "u1"), ("dlc", "u1"), ("can_id", "<u4"), ("frame_bits", "<u4"),
        ("arbitration_bits", "u1"), ("fd_flags", "u1"), ("length", "u1"), ("reserved", "u1", 5),
        ("data", "u1", fr.MAX_FD_LENGTH),
    ]
)  # fmt: skip
DLC = np.repeat(np.arange(16), np.diff([-1, *range(9), 12, 16, 20, 24, 32, 48, 64]))  # of a length
EDL = 1  # a CAN FD frame


class Piece(NamedTuple):
    """A container: method, stated size of its content, content, and whether the file cuts it."""

    method: int
    size: int
    packed: memoryview
    is_cut: bool


class Content(NamedTuple):
    """What a container held, whether that is all of it, and what follows behind its end."""

    data: bytes | memoryview
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


def _inflate(budget: Budget, piece: Piece) -> Content:
    """What a container holds; LogError if that is more than any writer puts into one.

    zlib's checksum stands at the end of the stream: without it content is taken only where the
    file itself ends, because all bytes before a cut are good.
    """
    if piece.method == STORED:
        whole = len(piece.packed) == piece.size
        return Content(piece.packed if whole or piece.is_cut else b"", whole)
    engine = zlib.decompressobj()
    try:
        content = engine.decompress(piece.packed, MAX_CONTAINER + 1)
    except zlib.error:
        return Content(b"", False)
    if len(content) > MAX_CONTAINER:
        raise budget.exceeded()
    if not engine.eof:
        return Content(content if piece.is_cut else b"", False)
    return Content(content, True, engine.unused_data[PADDING:].strip(b"\0"))


def _containers(raw: bytes) -> list[Piece]:
    """All containers of a file.

    A deflated one reaches to the next one, whatever its own size field says: zlib knows its end.
    """
    places = [match.start() for match in CONTAINER_START.finditer(raw)]
    pieces, whole = [], memoryview(raw)
    for pos, stop in itertools.pairwise([*places, len(raw)]):
        end = pos + OBJECT.unpack_from(raw, pos)[3]
        method, size = CONTAINER.unpack_from(raw, pos + OBJECT.size)
        packed = whole[pos + OBJECT.size + CONTAINER.size : min(stop, end) if not method else stop]
        pieces.append(Piece(method, size, packed, stop == len(raw) and end > stop))
    return pieces


def _contents(path: Path, pieces: list[Piece]) -> Iterator[Content]:
    """What each container holds; LogError if all of it is too much."""
    budget = Budget(path)
    with ThreadPoolExecutor(2) as pool:  # zlib releases the interpreter lock
        for k in range(0, len(pieces), AT_ONCE):
            for content in pool.map(partial(_inflate, budget), pieces[k : k + AT_ONCE]):
                budget.take(len(content.data))
                yield content


def _segments(
    path: Path, pieces: list[Piece], is_cut: bool, counts: NDArray[np.int64]
) -> tuple[NDArray[np.uint8], list[int], bool]:
    """All content, the borders that no object may cross, and if the last piece is lost; counts.

    Between two containers lies nothing but padding, or a container whose head is damaged; behind
    the last one of a cut file, what is left of the next one.
    """
    text, borders, is_lost = bytearray(), [0], False
    for k, content in enumerate(_contents(path, pieces)):
        text += content.data
        is_lost = not (content.is_whole or pieces[k].is_cut)
        counts[BAD_CONTAINER] += is_lost
        if content.rest and not (is_cut and k + 1 == len(pieces)):
            counts[OTHER if content.rest.startswith(SIGNATURE) else BAD_CONTAINER] += 1
        if content.rest or not content.is_whole:
            borders.append(len(text))
    if len(text) > borders[-1]:
        borders.append(len(text))
    return np.frombuffer(text, np.uint8), borders, is_lost


def read(path: Path) -> Frames:
    """All classic data frames of a BLF file; LogError if it is none."""
    raw = path.read_bytes()
    pieces = _containers(raw)
    if len(raw) < HEADER_BYTES or (raw[:4] != b"LOGG" and not pieces):
        raise LogError(f"{path}: not a BLF file (no LOGG header); check the file or its suffix")
    counts = np.zeros(len(REASONS), np.int64)
    is_cut = _is_cut(raw, pieces)
    text, borders, is_lost = _segments(path, pieces, is_cut, counts)
    for longest in (fr.MAX_LENGTH, fr.MAX_FD_LENGTH):
        frames, inner = _frames(text, borders, _start_us(raw), longest)
        if not inner[FD]:  # all of them have room
            break
    counts += inner
    if is_lost:
        counts[BAD], counts[TRUNCATED] = counts[BAD] + counts[TRUNCATED], 0
    counts[TRUNCATED] = counts[TRUNCATED] > 0 or is_cut
    fr.add_counts(frames.refused, dict(zip(REASONS, counts.tolist(), strict=True)))
    return frames


def _frames(
    text: NDArray[np.uint8], borders: list[int], start_us: int, longest: int
) -> tuple[Frames, NDArray[np.int64]]:
    """Frames of at most so many bytes in the pieces between the borders, and what else is there."""
    counts = np.zeros(len(REASONS), np.int64)
    out, n = fr.empty(len(text) // MIN_OBJECT + 1, longest), 0
    for begin, end in itertools.pairwise(borders):
        counts[BAD] += counts[TRUNCATED]  # the object before this one ends in a lost container
        counts[TRUNCATED] = 0
        n = parse(
            text, begin, end, start_us, out.t_us, out.channel, out.can_id, out.length, out.data,
            n, counts,
        )  # fmt: skip
    return fr.narrowed(out[:n]), counts


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
        try:
            self._write_header()
        except OSError:
            self._file.close()
            raise

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file_bytes

    @property
    def has_frames(self) -> bool:
        """Whether some are in it."""
        return self._objects > 0

    def write(self, frames: Frames) -> None:
        """Append frames, of at least the start's time; OSError where the disk takes no more."""
        if not len(frames):
            return
        content = _inner(frames, self._start_ms).tobytes()
        parts = [content[k : k + WRITE_BYTES] for k in range(0, len(content), WRITE_BYTES)]
        packed = b"".join(map(_container, parts))
        if self._file.write(packed) != len(packed):  # unbuffered: a disk that fills takes a part
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), self._file.name)
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
    is_fd = frames.length > fr.MAX_LENGTH
    layout = FD_OBJECT if is_fd.any() else CAN_OBJECT
    objects = np.zeros(len(frames), layout)
    objects["signature"], objects["header_size"], objects["header_version"] = SIGNATURE, 32, 1
    objects["size"], objects["type"], objects["flags"] = layout.itemsize, 86, 2
    objects["t_ns"] = (frames.t_us - start_ms * 1000) * 1000
    objects["channel"] = frames.channel.astype(np.uint16) + 1
    objects["length"], objects["can_id"] = frames.length, frames.can_id
    objects["data"][:, : frames.data.shape[1]] = frames.data[:, : objects["data"].shape[1]]
    if layout is FD_OBJECT:
        objects["type"], objects["dlc"] = CAN_FD_MESSAGE, DLC[frames.length]
        objects["fd_flags"] = np.where(is_fd, EDL, 0)
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
