"""BLF logs (Vector binary logging format), read in bulk.

A file is a header and a chain of objects; containers (type 10) hold zlib-compressed pieces of one
inner chain of objects, which may straddle containers.  Containers are inflated in parallel, then
one compiled pass walks the inner chain.  A damaged container is skipped and counted; behind it the
walk finds the next object by its signature.
"""

from __future__ import annotations

import datetime
import itertools
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, inlined, kernel
from firmware_bridge.sources.errors import LogError

REASONS = (
    "bad_object",
    "other_object",  # markers, statistics and other objects that are no frames
    "remote_frame",
    "fd_frame",
    "error_frame",
    "truncated",
    "bad_container",
)
OK, BAD, OTHER, REMOTE, FD, ERROR, TRUNCATED, BAD_CONTAINER = -1, 0, 1, 2, 3, 4, 5, 6

SIGNATURE = b"LOBJ"
LOBJ = int.from_bytes(SIGNATURE, "little")
OBJECT = struct.Struct("<4sHHLL")  # signature, header size, header version, object size, type
CONTAINER = struct.Struct("<H6xL4x")  # compression method, inflated size
CONTAINER_TYPE = 10
HEADER_BYTES = 144
STORED, DEFLATED = 0, 2
MAX_CONTAINER = 64 << 20  # inflated; python-can and Vector write 128 KiB
MIN_OBJECT = 32
WRITE_BYTES = 128 << 10

CAN_OBJECT = np.dtype(
    [
        ("signature", "S4"), ("header_size", "<u2"), ("header_version", "<u2"),
        ("size", "<u4"), ("type", "<u4"),
        ("flags", "<u4"), ("client", "<u2"), ("version", "<u2"), ("t_ns", "<u8"),
        ("channel", "<u2"), ("direction", "u1"), ("length", "u1"), ("can_id", "<u4"),
        ("data", "u1", 8),
    ]
)  # fmt: skip


@inlined
def _number(text: NDArray[np.uint8], pos: Integer, n: Integer) -> Integer:
    """Little-endian number of n bytes."""
    value = np.int64(0)
    for k in range(n):
        value |= np.int64(text[pos + k]) << (8 * k)
    return value


@inlined
def _find(text: NDArray[np.uint8], pos: Integer, stop: Integer) -> Integer:
    """Next object in text[pos:stop], or stop if there is none."""
    while pos + MIN_OBJECT <= stop:
        if text[pos] == 76 and _number(text, pos, 4) == LOBJ:
            return pos
        pos += 1
    return stop


@inlined
def _layout(
    text: NDArray[np.uint8], kind: Integer, body: Integer
) -> tuple[Integer, Integer, Integer, bool]:
    """Payload length, position of the data, channel and remote flag of a frame object."""
    if kind == 100:  # CAN_FD_MESSAGE
        remote = text[body + 2] & 0x80 != 0
        return np.int64(text[body + 14]), body + 20, _number(text, body, 2), remote
    if kind == 101:  # CAN_FD_MESSAGE_64
        remote = text[body + 12] & 0x10 != 0
        return np.int64(text[body + 2]), body + 40, np.int64(text[body]), remote
    remote = text[body + 2] & 0x80 != 0
    return np.int64(text[body + 3]), body + 8, _number(text, body, 2), remote


@inlined
def _object(
    text: NDArray[np.uint8], pos: Integer, end: Integer, start_us: Integer, t_us: NDArray[np.int64],
    channel: NDArray[np.uint8], can_id: NDArray[np.uint32], length: NDArray[np.uint8],
    data: NDArray[np.uint8], k: Integer,
) -> Integer:  # fmt: skip
    """Read the object text[pos:end] into row k of the arrays (changed in place); OK or why not."""
    kind, version = _number(text, pos + 12, 4), _number(text, pos + 6, 2)
    if kind in (2, 73):
        return ERROR
    if kind not in (1, 86, 100, 101):
        return OTHER
    body = pos + (40 if version == 2 else 32)
    if version not in (1, 2) or end - body < (16 if kind in (1, 86) else 40):
        return BAD
    n, first, number, remote = _layout(text, kind, body)
    if remote:
        return REMOTE
    if n > 8:
        return FD if kind >= 100 else BAD
    stamp = _number(text, pos + 24, 8)
    t_us[k] = start_us + (stamp * 10 if text[pos + 16] == 1 else (stamp + 500) // 1000)
    channel[k], can_id[k], length[k] = number - 1, _number(text, body + 4, 4), n
    for i in range(8):
        data[k, i] = text[first + i] if i < n and first + i < end else 0
    return OK


@kernel
def parse(
    text: NDArray[np.uint8], pos: Integer, stop: Integer, start_us: Integer,
    t_us: NDArray[np.int64], channel: NDArray[np.uint8], can_id: NDArray[np.uint32],
    length: NDArray[np.uint8], data: NDArray[np.uint8], n: Integer, counts: NDArray[np.int64],
) -> Integer:  # fmt: skip
    """Walk the objects in text[pos:stop], appending frames from row n on; the new n.

    Changed in place: the arrays (room for every object) and counts (REASONS,).
    """
    while True:
        found = _find(text, pos, stop)
        counts[BAD] += found > pos + 8 and found < stop
        if found >= stop:
            counts[TRUNCATED] += stop - pos > 8
            return n
        size = _number(text, found + 8, 4)
        if size < MIN_OBJECT or found + size > stop:
            pos = found + 4
            if _find(text, pos, stop) >= stop:
                counts[TRUNCATED] += 1
                return n
            counts[BAD] += 1
            continue
        pos = found + size
        result = _object(text, found, pos, start_us, t_us, channel, can_id, length, data, n)
        if result == OK:
            n += 1
        else:
            counts[result] += 1


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


def _inflate(piece: tuple[int, bytes]) -> tuple[bytes, bool]:
    """Content of one container, and whether it is whole."""
    method, packed = piece
    if method == STORED:
        return packed, True
    try:
        engine = zlib.decompressobj()
        content = engine.decompress(packed, MAX_CONTAINER)
    except zlib.error:
        return b"", False
    return content, engine.eof


def _containers(raw: bytes, counts: NDArray[np.int64]) -> list[tuple[int, bytes]]:
    """Compression method and packed bytes of every container; counts changed in place."""
    pieces = []
    pos = raw.find(SIGNATURE, int.from_bytes(raw[4:8], "little"))
    while pos >= 0 and pos + OBJECT.size + CONTAINER.size <= len(raw):
        _, _, _, size, kind = OBJECT.unpack_from(raw, pos)
        end = pos + size
        if kind == CONTAINER_TYPE and size >= OBJECT.size + CONTAINER.size:
            method, _ = CONTAINER.unpack_from(raw, pos + OBJECT.size)
            if method in (STORED, DEFLATED):
                pieces.append((method, raw[pos + OBJECT.size + CONTAINER.size : end]))
            else:
                counts[BAD_CONTAINER] += 1
            counts[TRUNCATED] += end > len(raw)
        else:
            counts[OTHER] += 1
        pos = raw.find(SIGNATURE, max(end, pos + 4))
    counts[TRUNCATED] += 0 <= pos < len(raw)
    return pieces


def _segments(contents: list[tuple[bytes, bool]]) -> tuple[bytes, list[int]]:
    """All content in one piece, and the borders that no object may cross."""
    borders = [0]
    size = 0
    for content, whole in contents:
        size += len(content)
        if not whole:
            borders.append(size)
    borders.append(size)
    return b"".join([content for content, _ in contents]), borders


def read(path: Path) -> Frames:
    """All classic data frames of a BLF file; LogError if it is none."""
    raw = path.read_bytes()
    if raw[:4] != b"LOGG" or len(raw) < HEADER_BYTES:
        raise LogError(f"{path}: not a BLF file (no LOGG header); check the file or its suffix")
    counts = np.zeros(len(REASONS), np.int64)
    pieces = _containers(raw, counts)
    with ThreadPoolExecutor(2) as pool:  # zlib releases the interpreter lock
        contents = list(pool.map(_inflate, pieces))
    counts[BAD_CONTAINER] += sum(not content for content, _ in contents)
    joined, borders = _segments(contents)
    text = np.frombuffer(joined, np.uint8)
    out = fr.empty(len(text) // MIN_OBJECT + 1)
    n, start_us = 0, _start_us(raw)
    for begin, end in itertools.pairwise(borders):
        n = parse(
            text, begin, end, start_us, out.t_us, out.channel, out.can_id, out.length, out.data,
            n, counts,
        )  # fmt: skip
    found = out[:n]
    fr.add_counts(found.refused, dict(zip(REASONS, counts.tolist(), strict=True)))
    return found


def write(path: Path, frames: Frames) -> None:
    """Write frames as a BLF file, in bulk; python-can and Vector tools read it."""
    start_ms = int(frames.t_us.min()) // 1000 if len(frames) else 0
    objects = np.zeros(len(frames), CAN_OBJECT)
    objects["signature"], objects["header_size"], objects["header_version"] = SIGNATURE, 32, 1
    objects["size"], objects["type"], objects["flags"] = CAN_OBJECT.itemsize, 86, 2
    objects["t_ns"] = (frames.t_us - start_ms * 1000) * 1000
    objects["channel"] = frames.channel.astype(np.uint16) + 1
    objects["length"], objects["can_id"] = frames.length, frames.can_id
    objects["data"] = frames.data
    content = objects.tobytes()
    parts = [content[k : k + WRITE_BYTES] for k in range(0, len(content), WRITE_BYTES)]
    packed = [_container(part) for part in parts]
    sizes = HEADER_BYTES + sum(map(len, packed)), HEADER_BYTES + len(content) + 32 * len(parts)
    stop_ms = int(frames.t_us.max()) // 1000 if len(frames) else 0
    path.write_bytes(_header(sizes, len(frames), start_ms, stop_ms) + b"".join(packed))


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
