"""The objects inside the containers of a BLF log: frames, and all others that are only counted.

An object is a header (signature, sizes, type, time stamp) and a body that depends on the type.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.jit import Integer, inlined, kernel

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
MIN_OBJECT = 32
CAN_FD_MESSAGE, CAN_FD_MESSAGE_64 = 100, 101  # hold classic frames too


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
    if kind == CAN_FD_MESSAGE:
        remote = text[body + 2] & 0x80 != 0
        return np.int64(text[body + 14]), body + 20, _number(text, body, 2), remote
    if kind == CAN_FD_MESSAGE_64:
        remote = text[body + 12] & 0x10 != 0
        return np.int64(text[body + 2]), body + 40, np.int64(text[body]), remote
    remote = text[body + 2] & 0x80 != 0
    return np.int64(text[body + 3]), body + 8, _number(text, body, 2), remote


@inlined
def _object(  # noqa: PLR0911  each return names what is wrong with the object
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
    if n > (8 if kind in (1, 86) else 64):
        return BAD
    if n > data.shape[1]:
        return FD
    stamp = _number(text, pos + 24, 8)
    t_us[k] = start_us + (stamp * 10 if text[pos + 16] == 1 else (stamp + 500) // 1000)
    channel[k], can_id[k], length[k] = number - 1, _number(text, body + 4, 4), n
    for i in range(data.shape[1]):
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
        start_at = _find(text, pos, stop)
        counts[BAD] += start_at > pos + 8 and start_at < stop
        if start_at >= stop:
            counts[TRUNCATED] += stop - pos > 8
            return n
        size = _number(text, start_at + 8, 4)
        if size < MIN_OBJECT or start_at + size > stop:
            pos = start_at + 4
            if _find(text, pos, stop) >= stop:
                counts[TRUNCATED] += 1
                return n
            counts[BAD] += 1
            continue
        pos = start_at + size
        result = _object(text, start_at, pos, start_us, t_us, channel, can_id, length, data, n)
        if result == OK:
            n += 1
        else:
            counts[result] += 1
