"""CSV logs of frames as python-can's CSVWriter writes them, parsed in bulk over the bytes.

    timestamp,arbitration_id,extended,remote,error,dlc,data
    1483389946.197,0x00dadada,1,0,0,6,WzQyLCA5XQ==

Stamps are seconds in as many digits as a float needs; data is base64; no channel: it reads as 0.
Not to be confused with tables of samples (`firmware_bridge.sources.table`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.jit import Integer, inlined, kernel
from firmware_bridge.sources import text as tx
from firmware_bridge.sources.text import BAD, ERROR, FD, NOTHING, OK, REMOTE, Rows

LIKE = "'1.5,0x120,0,0,0,2,ABE=' (a table of samples is no log of frames)"
LOOK = rb"\Atimestamp,arbitration_id,|\d,0x[0-9a-fA-F]+,[01],[01],[01],\d"
COMMA, EQUALS, MINUS, SMALL_E, SMALL_X = 44, 61, 45, 101, 120
HEADER = tx.code("timestamp")
HEADER_BYTES = len("timestamp,arbitration_id,extended,remote,error,dlc,data\n")

_BASE64 = np.full(256, 255, np.int64)
for _k, _c in enumerate(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"):
    _BASE64[_c] = _k


@inlined
def _field(text: NDArray[np.uint8], pos: Integer, end: Integer) -> Integer:
    """Position of the next comma."""
    while pos < end and text[pos] != COMMA:
        pos += 1
    return pos


@inlined
def _time(text: NDArray[np.uint8], pos: Integer, end: Integer) -> Integer:
    """Microseconds of a Python float, which is at least 0; -1 if malformed."""
    t_us, last = tx.micro(text, pos, end, False)
    if last == end:
        return t_us
    if last < 0 or last + 4 != end or text[last] != SMALL_E or text[last + 1] != MINUS:
        return -1
    exponent = tx.number(text, last + 2, end, 10)  # below 1e-4 s, a float has one
    return -1 if exponent < 0 else np.int64(np.rint(t_us * 10.0**-exponent))


@inlined
def _base64(
    text: NDArray[np.uint8], pos: Integer, end: Integer, size: Integer, data: NDArray[np.uint8]
) -> Integer:
    """Decode `size` bytes into data (changed in place); the position behind, -1 if malformed."""
    data[:] = 0
    behind = pos + (size + 2) // 3 * 4
    if behind > end:
        return -1
    bits, value, n = 0, np.int64(0), 0
    for k in range(pos, behind):
        letter = _BASE64[text[k]]
        if n < size and letter < 64:
            value, bits = (value << 6 | letter) & 0xFFFF, bits + 6
        elif n < size or text[k] != EQUALS:
            return -1
        if bits >= 8:
            bits -= 8
            data[n], n = value >> bits & 0xFF, n + 1
    return -1 if value & ((1 << bits) - 1) else behind  # padding bits are 0


@inlined
def _flag(text: NDArray[np.uint8], first: Integer, last: Integer) -> Integer:
    return tx.number(text, first, last, 2) if last == first + 1 else -1


@inlined
def _line(  # noqa: PLR0911  each return names what is wrong with the line
    text: NDArray[np.uint8], pos: Integer, end: Integer, rows: Rows, k: Integer
) -> tuple[Integer, Integer]:
    """Parse text[pos:end] into row k (changed in place); OK or why not, and where to go on."""
    if tx.skip(text, pos, end) == end:
        return NOTHING, end
    if tx.word(text, pos, end) == HEADER:
        return NOTHING, pos + HEADER_BYTES
    last = _field(text, pos, end)
    rows.t_us[k], first = _time(text, pos, last), last + 1
    last = _field(text, first, end)
    is_hex = last > first + 2 and text[first] == 48 and text[first + 1] == SMALL_X
    identifier = tx.number(text, first + 2, last, 16) if is_hex else -1
    first, last = last + 1, _field(text, last + 1, end)
    extended = _flag(text, first, last)
    first, last = last + 1, _field(text, last + 1, end)
    remote = _flag(text, first, last)
    first, last = last + 1, _field(text, last + 1, end)
    error = _flag(text, first, last)
    first, last = last + 1, _field(text, last + 1, end)
    size = tx.number(text, first, last, 10)
    if min(rows.t_us[k], identifier, extended, remote, error, size) < 0 or last == end:
        return BAD, end
    if error:
        return ERROR, end
    first = last + 1
    is_empty = tx.skip(text, first, end) == end
    if remote:
        return REMOTE if is_empty else BAD, end
    if identifier > (0x1FFF_FFFF if extended else 0x7FF) or size > 64:
        return BAD, end
    if size > len(rows.data[k]):
        return FD, end
    rows.can_id[k], rows.length[k] = identifier | (EXTENDED if extended else 0), size
    behind = _base64(text, first, end, size, rows.data[k])
    if behind < 0:
        return BAD, end
    return (OK, end) if tx.skip(text, behind, end) == end else (BAD, behind + 1)


@kernel
def parse(
    text: NDArray[np.uint8], starts: NDArray[np.int64], stops: NDArray[np.int64], rows: Rows,
    counts: NDArray[np.int64],
) -> Integer:  # fmt: skip
    """Parse all lines into rows; the number of frames.  Changed in place: rows, counts.

    text (bytes,); starts, stops (lines,); counts (reasons,).
    """
    n = 0
    for i in range(len(starts)):
        pos, first = starts[i], True
        while pos < stops[i]:
            result, after = _line(text, pos, stops[i], rows, n)
            n += tx.counted(result, first, counts)
            pos, first = after if first else stops[i], False
    return n


def read(path: Path) -> Frames:
    """All classic data frames of a CSV log of python-can; LogError if it is none."""
    return tx.read(path, np.fromfile(path, np.uint8), LIKE, parse)
