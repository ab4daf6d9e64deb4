"""candump -L logs, parsed in bulk over the bytes.

One line per frame: (seconds.fraction) channel ID#DATA, ID of 3 (standard) or 8 (extended) hex
digits, DATA of 0 to 16, optionally followed by R or T (direction).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, inlined, kernel
from firmware_bridge.sources.errors import LogError

REASONS = ("bad_line", "remote_frame", "fd_frame", "error_frame", "truncated")
OK, BAD, REMOTE, FD, ERROR, TRUNCATED = -1, 0, 1, 2, 3, 4
NEWLINE, CR, SPACE, HASH = 10, 13, 32, 35
BYTES_PER_LINE = 20  # shortest line: "(0.0) c 001#" and its newline is longer than half of this

_HEX = np.full(256, 255, np.int64)
for _k, _c in enumerate(b"0123456789abcdef"):
    _HEX[_c] = _HEX[ord(chr(_c).upper())] = _k


@inlined
def _time(text: NDArray[np.uint8], pos: Integer, end: Integer) -> tuple[Integer, Integer]:
    """Microseconds of "(seconds.fraction) " and the position behind it; -1 if malformed."""
    if pos >= end or text[pos] != 40:  # (
        return 0, -1
    pos += 1
    digits, n_whole = 0, 0
    whole: Integer = 0
    fraction: Integer = 0
    while pos < end and 48 <= text[pos] <= 57 and n_whole < 13:
        whole, pos, n_whole = whole * 10 + np.int64(text[pos] - 48), pos + 1, n_whole + 1
    if n_whole and pos < end and text[pos] == 46:  # .
        pos += 1
        while pos < end and 48 <= text[pos] <= 57 and digits < 9:
            fraction, pos, digits = fraction * 10 + np.int64(text[pos] - 48), pos + 1, digits + 1
    if n_whole == 0 or pos + 1 >= end or text[pos] != 41 or text[pos + 1] != SPACE:
        return 0, -1
    while digits < 9:
        fraction, digits = fraction * 10, digits + 1
    return whole * 1_000_000 + (fraction + 500) // 1000, pos + 2


@inlined
def _channel(text: NDArray[np.uint8], pos: Integer, end: Integer) -> tuple[Integer, Integer]:
    """Number at the end of the channel's name and the position behind it; -1 if malformed."""
    start = pos
    number: Integer = 0
    while pos < end and text[pos] != SPACE:
        digit = 48 <= text[pos] <= 57
        number = (number * 10 + np.int64(text[pos] - 48)) & 0xFFFF if digit else 0
        pos += 1
    return (number & 0xFF, pos + 1) if start < pos < end else (0, -1)


@inlined
def _identifier(text: NDArray[np.uint8], pos: Integer, end: Integer) -> tuple[Integer, Integer]:
    """Identifier with its flags in bits 29 to 31 and the position behind #; -1 if malformed."""
    start = pos
    can_id: Integer = 0
    while pos < end and _HEX[text[pos]] < 16 and pos - start < 8:
        can_id, pos = can_id * 16 + _HEX[text[pos]], pos + 1
    if pos >= end or text[pos] != HASH or pos - start not in (3, 8):
        return 0, -1
    if pos - start == 8 and can_id < 0x2000_0000:
        can_id |= 0x8000_0000
    return can_id, pos + 1


@inlined
def _payload(
    text: NDArray[np.uint8], pos: Integer, end: Integer, data: NDArray[np.uint8]
) -> Integer:
    """Number of hex bytes put into data (changed in place); -1 if malformed."""
    n = 0
    while pos < end and text[pos] != SPACE:
        if n == 8 or pos + 1 >= end:
            return -1
        high, low = _HEX[text[pos]], _HEX[text[pos + 1]]
        if high > 15 or low > 15:
            return -1
        data[n] = high * 16 + low
        n, pos = n + 1, pos + 2
    tail = end - pos
    direction = tail == 2 and text[pos + 1] in (82, 84, 114, 116)  # R T r t
    return n if tail == 0 or direction else -1


@inlined
def _line(  # noqa: PLR0911  each return names what is wrong with the line
    text: NDArray[np.uint8], pos: Integer, end: Integer, t_us: NDArray[np.int64],
    channel: NDArray[np.uint8], can_id: NDArray[np.uint32], length: NDArray[np.uint8],
    data: NDArray[np.uint8], k: Integer,
) -> Integer:  # fmt: skip
    """Parse text[pos:end] into row k of the arrays (changed in place); OK or why not."""
    t_us[k], pos = _time(text, pos, end)
    if pos < 0:
        return BAD
    number, pos = _channel(text, pos, end)
    if pos < 0:
        return BAD
    identifier, pos = _identifier(text, pos, end)
    if pos < 0:
        return BAD
    channel[k], can_id[k] = number, identifier
    if identifier & 0x2000_0000:
        return ERROR
    if pos < end and text[pos] == HASH:
        return FD
    if pos < end and (text[pos] == 82 or text[pos] == 114):
        return REMOTE
    data[k] = 0
    n = _payload(text, pos, end, data[k])
    length[k] = max(n, 0)
    return OK if n >= 0 else BAD


@kernel
def parse(
    text: NDArray[np.uint8], t_us: NDArray[np.int64], channel: NDArray[np.uint8],
    can_id: NDArray[np.uint32], length: NDArray[np.uint8], data: NDArray[np.uint8],
    counts: NDArray[np.int64],
) -> Integer:  # fmt: skip
    """Parse all lines into the arrays; the number of frames.

    Changed in place: the arrays (room for one frame per line) and counts (REASONS,).  A last line
    without a newline is a cut one: its data may be short without being malformed.
    """
    n, pos, size = 0, 0, len(text)
    while pos < size:
        end = pos
        while end < size and text[end] != NEWLINE:
            end += 1
        stop = end
        while stop > pos and (text[stop - 1] == CR or text[stop - 1] == SPACE):
            stop -= 1
        if end == size:
            counts[TRUNCATED] += 1
        elif stop > pos:
            result = _line(text, pos, stop, t_us, channel, can_id, length, data, n)
            if result == OK:
                n += 1
            else:
                counts[result] += 1
        pos = end + 1
    return n


def read(path: Path) -> Frames:
    """All frames of a candump log; LogError if it holds none but malformed lines."""
    text = np.fromfile(path, np.uint8)
    n_lines = int(np.count_nonzero(text == NEWLINE))
    out = fr.empty(n_lines + 1)
    counts = np.zeros(len(REASONS), np.int64)
    n = parse(text, out.t_us, out.channel, out.can_id, out.length, out.data, counts)
    if n == 0 and counts[BAD]:
        raise LogError(
            f"{path}: not a candump log: no line looks like '(1.5) can0 120#0011'; "
            "record it with candump -L, or give the file its right suffix"
        )
    found = out[:n]
    fr.add_counts(found.refused, dict(zip(REASONS, counts.tolist(), strict=True)))
    return found


def write(path: Path, frames: Frames) -> None:
    """Write frames as a candump log, channel n as can<n>."""
    digits = frames.data.tobytes().hex().upper()
    with path.open("w", encoding="ascii") as file:
        for k in range(len(frames)):
            seconds, micro = divmod(int(frames.t_us[k]), 1_000_000)
            can_id, n = int(frames.can_id[k]), int(frames.length[k])
            name = f"{can_id & 0x1FFFFFFF:08X}" if can_id & fr.EXTENDED else f"{can_id:03X}"
            payload = digits[16 * k : 16 * k + 2 * n]
            file.write(f"({seconds}.{micro:06d}) can{frames.channel[k]} {name}#{payload}\n")
