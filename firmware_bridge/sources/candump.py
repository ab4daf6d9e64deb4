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
from firmware_bridge.sources import text as tx
from firmware_bridge.sources.text import BAD, ERROR, FD, HEX, NOTHING, OK, REMOTE, SPACE, Rows

HASH, OPEN, CLOSE = 35, 40, 41
LIKE = "'(1.5) can0 120#0011'; record it with candump -L"


@inlined
def _time(text: NDArray[np.uint8], pos: Integer, end: Integer) -> tuple[Integer, Integer]:
    """Microseconds of "(seconds.fraction) " and the position behind it; -1 if malformed."""
    if text[pos] != OPEN:
        return 0, -1
    t_us, pos = tx.micro(text, pos + 1, end, True)
    if pos < 0 or pos + 1 >= end or text[pos] != CLOSE or text[pos + 1] != SPACE:
        return 0, -1
    return t_us, pos + 2


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
    while pos < end and HEX[text[pos]] < 16 and pos - start < 8:
        can_id, pos = can_id * 16 + HEX[text[pos]], pos + 1
    if pos >= end or text[pos] != HASH or pos - start not in (3, 8):
        return 0, -1
    if pos - start == 8 and can_id < 0x2000_0000:
        can_id |= 0x8000_0000
    return can_id, pos + 1


@inlined
def _payload(
    text: NDArray[np.uint8], pos: Integer, end: Integer, data: NDArray[np.uint8]
) -> tuple[Integer, Integer]:
    """Number of hex bytes put into data (changed in place), and the position behind them."""
    n = 0
    data[:] = 0
    while n < 8 and pos + 1 < end and HEX[text[pos]] < 16 and HEX[text[pos + 1]] < 16:
        data[n] = HEX[text[pos]] * 16 + HEX[text[pos + 1]]
        n, pos = n + 1, pos + 2
    return n, pos


@inlined
def _behind(text: NDArray[np.uint8], pos: Integer, end: Integer) -> tuple[Integer, Integer]:
    """OK if nothing but a direction (R, T) follows the data; else BAD and where a line begins."""
    first, last = tx.token(text, pos, end)
    if first == last or (first == pos + 1 and last == end and text[first] in (82, 84, 114, 116)):
        return OK, end
    while first < end and text[first] != OPEN:
        first += 1
    return BAD, first


@inlined
def _line(  # noqa: PLR0911  each return names what is wrong with the line
    text: NDArray[np.uint8], pos: Integer, end: Integer, rows: Rows, k: Integer
) -> tuple[Integer, Integer]:
    """Parse text[pos:end] into row k (changed in place); OK or why not, and where to go on."""
    pos = tx.skip(text, pos, end)
    if pos == end:
        return NOTHING, end
    rows.t_us[k], pos = _time(text, pos, end)
    if pos < 0:
        return BAD, end
    rows.channel[k], pos = _channel(text, pos, end)
    if pos < 0:
        return BAD, end
    identifier, pos = _identifier(text, pos, end)
    if pos < 0:
        return BAD, end
    if identifier & 0x2000_0000:
        return ERROR, end
    if pos < end and text[pos] == HASH:
        return FD, end
    if pos < end and (text[pos] == 82 or text[pos] == 114):
        return REMOTE, end
    rows.can_id[k] = identifier
    rows.length[k], pos = _payload(text, pos, end, rows.data[k])
    return _behind(text, pos, end)


@kernel
def parse(
    text: NDArray[np.uint8], starts: NDArray[np.int64], stops: NDArray[np.int64], rows: Rows,
    counts: NDArray[np.int64],
) -> Integer:  # fmt: skip
    """Parse all lines into rows; the number of frames.  Changed in place: rows, counts."""
    n = 0
    for i in range(len(starts)):
        pos, first = starts[i], True
        while pos < stops[i]:
            result, after = _line(text, pos, stops[i], rows, n)
            n += tx.counted(result, first, counts)
            pos, first = after if first else stops[i], False
    return n


def read(path: Path) -> Frames:
    """All frames of a candump log; LogError if it holds none but malformed lines."""
    return tx.read(path, np.fromfile(path, np.uint8), LIKE, parse)


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
