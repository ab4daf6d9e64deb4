"""ASC logs (Vector ASCII), parsed in bulk over the bytes.

A header names date, base of the numbers and kind of the time stamps; then one event per line:

    seconds channel ID[x] Rx|Tx d DLC bytes ... [Length = ...]
    seconds CANFD channel Rx|Tx ID[x] [name] BRS ESI DLC length bytes [duration bits flags ...]

A channel that is configured for CAN FD logs its classic frames in the second form as well.

Absolute stamps count from the (first) `Begin Triggerblock`, or from `date` where there is none, in
local time as Vector's and python-can's tools write it; relative ones from the event before, so what
follows a lost line is early by that one step.  Without a date the log starts at 0.  Stamps have
1 us, the date 1 ms; logs with fewer decimals (10 or 100 us in old ones) are as coarse as they are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.frames import EXTENDED, Frames, add_counts
from firmware_bridge.jit import Integer, inlined, kernel
from firmware_bridge.sources import text as tx
from firmware_bridge.sources.asc_header import Header, header
from firmware_bridge.sources.text import BAD, DOT, ERROR, FD, HEX, NOTHING, OK, OTHER, REMOTE, Rows

LIKE = "'1.500000 1  120  Rx  d 2 00 11'; log identifiers as numbers, not as names"
HEAD_BYTES, TAIL_BYTES = 4096, 64
SAMPLE_BYTES = 1 << 18
HEX_BASE = 16

RX, TX, LENGTH = tx.code("Rx"), tx.code("Tx"), tx.code("Length")
ERROR_FRAME, CANFD, START = tx.code("ErrorFrame"), tx.code("CANFD"), tx.code("Start")
HEADS = tuple(tx.code(name) for name in ("date", "base", "internal", "no", "begin", "end"))
LENGTHS = np.array([*range(9), 12, 16, 20, 24, 32, 48, 64])  # of a CAN FD frame, by its DLC
SLASH, SMALL_X, SMALL_D, SMALL_R = 47, 120, 100, 114


@inlined
def _is_head(text: NDArray[np.uint8], pos: Integer, end: Integer) -> bool:
    """Whether the line belongs to the header, a comment or a trigger block."""
    first, last = tx.token(text, pos, end)
    return text[first] == SLASH or tx.word(text, first, last) in HEADS


@inlined
def _identifier(text: NDArray[np.uint8], first: Integer, last: Integer, base: Integer) -> Integer:
    """Identifier, bit 31 set if it ends with x; -1 if malformed or too large."""
    long = last > first and text[last - 1] | 32 == SMALL_X
    value = tx.number(text, first, last - 1 if long else last, base)
    if value > (0x1FFF_FFFF if long else 0x7FF):
        return -1
    return value | EXTENDED if long and value >= 0 else value


@inlined
def _bytes(
    text: NDArray[np.uint8], pos: Integer, end: Integer, base: Integer, size: Integer,
    data: NDArray[np.uint8],
) -> Integer:  # fmt: skip
    """Read `size` bytes into data (changed in place); the position behind them, -1 if malformed.

    The last one may be followed by anything: the caller judges that.
    """
    data[:] = 0
    for k in range(size):
        first = tx.skip(text, pos, end)
        last = first
        while last < end and last < first + 3 and HEX[text[last]] < base:
            last += 1
        value = tx.number(text, first, last, base)
        if first == pos or value < 0 or value > 255 or (base == HEX_BASE and last - first != 2):
            return -1
        data[k], pos = value, last
    return pos


@inlined
def _next_line(text: NDArray[np.uint8], pos: Integer, end: Integer) -> Integer:
    """Where the next number with a fraction begins: the time stamp of a line joined to this."""
    dot = pos
    while dot < end and text[dot] != DOT:
        dot += 1
    first = dot
    while first - 1 > pos and 48 <= text[first - 1] <= 57:
        first -= 1
    return first if dot < end else end


@inlined
def _behind(
    text: NDArray[np.uint8], pos: Integer, end: Integer, is_fd: bool
) -> tuple[Integer, Integer]:
    """OK if nothing but the numbers of this frame follows its data; else BAD and where to go on."""
    first, last = tx.token(text, pos, end)
    further = _next_line(text, pos, end)
    good = first == last or (first > pos and tx.word(text, first, last) == LENGTH)
    if is_fd:
        good = first > pos or first == end
        for k in range(first, end):
            good = good and (HEX[text[k]] < HEX_BASE or text[k] <= tx.SPACE)
    return (OK, end) if good and further == end else (BAD, further)


@inlined
def _classic(  # noqa: PLR0911  each return names what is wrong with the line
    text: NDArray[np.uint8], pos: Integer, end: Integer, base: Integer, rows: Rows, k: Integer
) -> tuple[Integer, Integer]:
    """Read "ID Rx d DLC bytes" into row k (changed in place)."""
    first, last = tx.token(text, pos, end)
    if tx.word(text, first, last) == ERROR_FRAME:
        return ERROR, end
    identifier = _identifier(text, first, last, base)
    first, last = tx.token(text, last, end)
    direction = tx.word(text, first, last)
    if direction not in (RX, TX) or last - first != 2:
        return OTHER, end  # statistics, chip status, transport protocols
    first, last = tx.token(text, last, end)
    if identifier < 0 or last - first != 1:
        return BAD, end
    if text[first] == SMALL_R:
        return REMOTE, end
    is_data = text[first] == SMALL_D
    first, last = tx.token(text, last, end)
    size = tx.number(text, first, last, base)
    if not is_data or size < 0 or size > 15:
        return BAD, end
    size = min(size, 8)  # a DLC of 9 to 15 stands for 8 bytes
    pos = _bytes(text, last, end, base, size, rows.data[k])
    if pos < 0:
        return BAD, end
    rows.can_id[k], rows.length[k] = identifier, size
    return _behind(text, pos, end, False)


@inlined
def _flexible(  # noqa: PLR0911  each return names what is wrong with the line
    text: NDArray[np.uint8], pos: Integer, end: Integer, base: Integer, rows: Rows, k: Integer
) -> tuple[Integer, Integer]:
    """Read "Rx ID [name] BRS ESI DLC length bytes ..." into row k."""
    first, last = tx.token(text, pos, end)
    direction = tx.word(text, first, last)
    first, last = tx.token(text, last, end)
    if direction not in (RX, TX):
        return BAD, end
    if tx.word(text, first, last) == ERROR_FRAME:
        return ERROR, end
    identifier = _identifier(text, first, last, base)
    first, last = tx.token(text, last, end)
    if last - first != 1 or tx.number(text, first, last, 2) < 0:  # a name stands before BRS
        first, last = tx.token(text, last, end)
    flags = tx.number(text, first, last, 2)
    first, last = tx.token(text, last, end)
    flags = min(flags, tx.number(text, first, last, 2))
    first, last = tx.token(text, last, end)
    dlc = tx.number(text, first, last, base)
    first, last = tx.token(text, last, end)
    size = tx.number(text, first, last, 10)
    if identifier < 0 or flags < 0 or dlc < 0 or dlc > 15 or size < 0 or size > 64:
        return BAD, end
    if size == 0 and dlc > 0:
        return REMOTE, end
    if size > len(rows.data[k]):
        return FD, end
    pos = _bytes(text, last, end, base, size, rows.data[k])
    if pos < 0 or size != LENGTHS[dlc]:
        return BAD, end
    rows.can_id[k], rows.length[k] = identifier, size
    return _behind(text, pos, end, True)


@inlined
def _line(
    text: NDArray[np.uint8], pos: Integer, end: Integer, base: Integer, relative: bool,
    clock: NDArray[np.int64], rows: Rows, k: Integer,
) -> tuple[Integer, Integer]:  # fmt: skip
    """Parse text[pos:end] into row k (changed in place); OK or why not, and where to go on."""
    pos = tx.skip(text, pos, end)
    if pos == end:
        return NOTHING, end
    t_us, last = tx.micro(text, pos, end, True)
    if last < 0 or last == end or text[last] > tx.SPACE:
        return (NOTHING, end) if _is_head(text, pos, end) else (BAD, end)
    clock[0] = clock[0] + t_us if relative else t_us
    first, last = tx.token(text, last, end)
    if tx.word(text, first, last) == START:
        return NOTHING, end
    is_fd = tx.word(text, first, last) == CANFD
    if is_fd:
        first, last = tx.token(text, last, end)
    channel = tx.number(text, first, last, 10)
    if channel < 1 or channel > 256:
        return OTHER, end
    rows.t_us[k], rows.channel[k] = clock[0], channel - 1
    if is_fd:
        return _flexible(text, last, end, base, rows, k)
    return _classic(text, last, end, base, rows, k)


@kernel
def parse(
    text: NDArray[np.uint8], starts: NDArray[np.int64], stops: NDArray[np.int64], rows: Rows,
    counts: NDArray[np.int64], base: Integer, relative: bool,
) -> Integer:  # fmt: skip
    """Parse all lines into rows; the number of frames.  Changed in place: rows, counts.

    text (bytes,); starts, stops (lines,); counts (reasons,).
    """
    n, clock = 0, np.zeros(1, np.int64)
    for i in range(len(starts)):
        pos, first = starts[i], True
        while pos < stops[i]:
            result, after = _line(text, pos, stops[i], base, relative, clock, rows, n)
            n += tx.counted(result, first, counts)
            pos, first = after if first else stops[i], False
    return n


def _base(head: Header, text: NDArray[np.uint8]) -> int:
    """The stated base of the numbers; of a damaged header, the one that yields more frames."""
    sample = text[:SAMPLE_BYTES]
    return head.base or max(
        (16, 10), key=lambda base: len(tx.scan(sample, parse, base, head.is_relative)[0])
    )


def read(path: Path) -> Frames:
    """All classic data frames of an ASC log; LogError if it is none."""
    text = np.fromfile(path, np.uint8)
    head = header(text[:HEAD_BYTES].tobytes())
    frames = tx.read(path, text, LIKE, parse, _base(head, text), head.is_relative)
    frames.t_us[:] += head.start_us
    add_counts(frames.refused, {"bad_date": int(head.has_bad_date)})
    add_counts(frames.refused, {"bad_line": int(head.has_bad_base)})
    if head.has_end_mark and b"end triggerblock" not in text[-TAIL_BYTES:].tobytes().lower():
        frames.refused.setdefault("truncated", 1)  # cut between two lines
    return frames
