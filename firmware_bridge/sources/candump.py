"""candump logs, parsed in bulk over the bytes.

One line per frame, as `candump -L` and `-l` write it: (seconds.fraction) channel ID#DATA, ID of 3
(standard) or 8 (extended) hex digits, DATA of 0 to 16, optionally followed by R or T (direction);
CAN FD: ID##fDATA with one digit of flags.  What candump shows on a terminal is put into this form:

    12  (1600000000.000100)  can0  TX - -  123   [8]  11 22 33 44 55 66 77 88   '."3DUfw.'

with or without a number and -x; stamps of -t a or A (absolute), z (from zero), d (differences).
"""

from __future__ import annotations

import datetime
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, inlined, kernel
from firmware_bridge.sources import text as tx
from firmware_bridge.sources.errors import LogError
from firmware_bridge.sources.text import BAD, ERROR, FD, HEX, NOTHING, OK, REMOTE, SPACE, Rows

HASH, OPEN, CLOSE = 35, 40, 41
HEAD_BYTES = 4096
LIKE = "'(1.5) can0 120#0011'; record it with candump -L"
LOOK = rb"\A\s*(\d+\s+)?\([\d.: -]+\)\s+\S+\s.*([0-9A-F]{3}#|\[\d+\])"
SHOWN = re.compile(
    rb"^[ \t]*(?:\d+[ \t]+)?\(([\d.: -]+)\)[ \t]+(\S+)[ \t]+(?:[RT]X [B-] [E-][ \t]+)?"
    rb"([0-9A-F]{3}|[0-9A-F]{8})[ \t]+\[(\d+)\][ \t]*"
    rb"(remote request|(?:[0-9A-F]{2}(?: |(?=\r?$)))*)(?: *'.*')?[ \t]*\r?$",
    re.MULTILINE,
)
GROWING = 0.9  # share of the steps that grow where stamps are no differences


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
    text: NDArray[np.uint8], pos: Integer, end: Integer, most: Integer, data: NDArray[np.uint8]
) -> tuple[Integer, Integer]:
    """Number of hex bytes put into data (changed in place), and the position behind them."""
    n = 0
    data[:] = 0
    while n < most and pos + 1 < end and HEX[text[pos]] < 16 and HEX[text[pos + 1]] < 16:
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
    is_fd = pos < end and text[pos] == HASH
    if is_fd and len(rows.data[k]) < fr.MAX_FD_LENGTH:
        return FD, end
    if is_fd and (pos + 1 >= end or HEX[text[pos + 1]] > 15):
        return BAD, end
    if pos < end and (text[pos] == 82 or text[pos] == 114):
        return REMOTE, end
    rows.can_id[k] = identifier
    first, most = (pos + 2, fr.MAX_FD_LENGTH) if is_fd else (pos, fr.MAX_LENGTH)
    rows.length[k], pos = _payload(text, first, end, most, rows.data[k])
    if is_fd and not tx.is_fd_length(rows.length[k]):
        return BAD, end
    return _behind(text, pos, end)


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
    """All frames of a candump log; LogError if it holds none but malformed lines."""
    text = np.fromfile(path, np.uint8)
    shown = SHOWN.search(text[:HEAD_BYTES].tobytes())
    if not shown:
        return tx.read(path, text, LIKE, parse)
    rewritten = np.frombuffer(SHOWN.sub(_rewritten, text.tobytes()), np.uint8)
    result, n_bad = tx.scan(rewritten, parse)
    if not len(result) and n_bad:
        raise LogError(f"{path}: no line looks like {LIKE}")
    if _is_differences(result.t_us):
        result.t_us[:] = np.cumsum(result.t_us)
    return tx.without_stray_stamps(result)


def _rewritten(line: re.Match[bytes]) -> bytes:
    """A line as -L writes it; as it is where its length or date is wrong."""
    stamp, channel, can_id, size, content = line.groups()
    if b":" in stamp:
        try:
            date = datetime.datetime.fromisoformat(stamp.decode().strip())
        except ValueError:
            return line[0]
        stamp = b"%.6f" % date.timestamp()
    if content == b"remote request":
        return b"(%b) %b %b#R" % (stamp, channel, can_id)
    payload = content.replace(b" ", b"")
    if len(payload) != 2 * int(size):
        return line[0]
    mark = b"##0" if int(size) > fr.MAX_LENGTH else b"#"
    return b"(%b) %b %b%b%b" % (stamp, channel, can_id, mark, payload)


def _is_differences(t_us: NDArray[np.int64]) -> bool:
    """Whether stamps are the time since the frame before (-t d): they begin at 0, then jump."""
    if len(t_us) < 2 or t_us[0] != 0:
        return False
    return bool((np.diff(t_us) > 0).mean() < GROWING)


def write(path: Path, frames: Frames) -> None:
    """Write frames as a candump log, channel n as can<n>."""
    digits, step = frames.data.tobytes().hex().upper(), 2 * frames.data.shape[1]
    with path.open("w", encoding="ascii") as file:
        for k in range(len(frames)):
            seconds, micro = divmod(int(frames.t_us[k]), 1_000_000)
            can_id, n = int(frames.can_id[k]), int(frames.length[k])
            name = f"{can_id & 0x1FFFFFFF:08X}" if can_id & fr.EXTENDED else f"{can_id:03X}"
            payload = digits[step * k : step * k + 2 * n]
            mark = "##0" if n > fr.MAX_LENGTH else "#"
            file.write(f"({seconds}.{micro:06d}) can{frames.channel[k]} {name}{mark}{payload}\n")
