"""CSV logs of frames as SavvyCAN and GVRET devices write them, parsed in bulk over the bytes.

    Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
    39747828,000005EB,false,Rx,0,8,E8,45,85,4B,4A,28,36,69,

The header tells the columns: older logs have no `Dir`, and simple loggers no `Bus` (channel 0).
Stamps are microseconds from any origin; what follows the bytes of the payload is padding.  Of a CAN
FD frame only eight bytes are written.  Remote and error frames are not marked.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.frames import EXTENDED, Frames
from firmware_bridge.jit import Integer, inlined, kernel
from firmware_bridge.sources import text as tx
from firmware_bridge.sources.text import BAD, FD, NOTHING, OK, Rows

LOOK = rb"\A(\xef\xbb\xbf)?(?i:time ?stamp,id,extended,)|(?i:\d,[0-9A-F]{8},(true|false),)"
LIKE = "'39747828,000005EB,false,Rx,0,2,E8,45' (microseconds, as SavvyCAN writes them)"
HEAD_BYTES = 256
COMMA, MAX_DIGITS, MAX_LENGTH = 44, 18, 64

STAMP, IDENTIFIER, IS_EXTENDED, DIRECTION, BUS, LENGTH = range(6)
NAMES = {"dir": DIRECTION, "bus": BUS, "len": LENGTH}  # behind the first three
TRUE, FALSE, RX, TX = tx.code("true"), tx.code("false"), tx.code("Rx"), tx.code("Tx")


@inlined
def _field(text: NDArray[np.uint8], pos: Integer, end: Integer) -> Integer:
    """Position of the next comma, or of what follows the line's last character."""
    while pos < end and text[pos] not in (COMMA, tx.CR):
        pos += 1
    return pos


@inlined
def _stamp(text: NDArray[np.uint8], first: Integer, last: Integer) -> Integer:
    """Microseconds; -1 if malformed."""
    value: Integer = 0
    if last <= first or last - first > MAX_DIGITS:
        return -1
    for k in range(first, last):
        if not 48 <= text[k] <= 57:
            return -1
        value = value * 10 + np.int64(text[k] - 48)
    return value


@inlined
def _value(text: NDArray[np.uint8], first: Integer, last: Integer, column: Integer) -> Integer:
    """What stands in a column before the payload; -1 if malformed."""
    if column == STAMP:
        return _stamp(text, first, last)
    if column == IDENTIFIER:
        return tx.number(text, first, last, 16)
    letters = tx.word(text, first, last)
    if column == IS_EXTENDED:
        return 1 if letters == TRUE else 0 if letters == FALSE else tx.number(text, first, last, 2)
    if column == DIRECTION:
        return 0 if letters in (RX, TX) else -1
    return tx.number(text, first, last, 10)


@inlined
def _payload(
    text: NDArray[np.uint8], pos: Integer, end: Integer, size: Integer, data: NDArray[np.uint8]
) -> Integer:
    """Read `size` bytes into data (changed in place); OK, or BAD if any field is no byte."""
    data[:] = 0
    n: Integer = 0
    while pos < end and text[pos] != tx.CR:
        last = _field(text, pos, end)
        value = tx.number(text, pos, last, 16) if last - pos <= 2 else -1
        if n < size:
            if value < 0:
                return BAD
            data[n] = value
        elif n < 8 and value < 0 and last > pos:
            return BAD
        n, pos = n + 1, last + 1
    return OK if n >= size else BAD


@inlined
def _line(
    text: NDArray[np.uint8], pos: Integer, end: Integer, columns: NDArray[np.int64], rows: Rows,
    k: Integer,
) -> Integer:  # fmt: skip
    """Parse text[pos:end] into row k (changed in place); OK or why not."""
    if tx.skip(text, pos, end) == end:
        return NOTHING
    fields = np.zeros(6, np.int64)
    for column in columns:
        last = _field(text, pos, end)
        fields[column] = _value(text, pos, last, column)
        if fields[column] < 0 or (last == end and column != LENGTH):
            return BAD
        pos = last + 1
    identifier, size = fields[IDENTIFIER], fields[LENGTH]
    extended = fields[IS_EXTENDED] or identifier > 0x7FF  # some loggers say "false" all the same
    if identifier > 0x1FFF_FFFF or size > MAX_LENGTH or fields[BUS] > 255:
        return BAD
    if size > 8:
        return FD
    rows.t_us[k], rows.channel[k] = fields[STAMP], fields[BUS]
    rows.can_id[k], rows.length[k] = identifier | (EXTENDED if extended else 0), size
    return _payload(text, pos, end, size, rows.data[k])


@kernel
def parse(
    text: NDArray[np.uint8], starts: NDArray[np.int64], stops: NDArray[np.int64], rows: Rows,
    counts: NDArray[np.int64], columns: NDArray[np.int64],
) -> Integer:  # fmt: skip
    """Parse all lines into rows; the number of frames.  Changed in place: rows, counts.

    text (bytes,); starts, stops (lines,); counts (reasons,); columns (columns,).
    """
    n = 0
    for i in range(len(starts)):
        is_header = i == 0  # `columns` is what it says
        result = NOTHING if is_header else _line(text, starts[i], stops[i], columns, rows, n)
        n += tx.counted(result, True, counts)
    return n


def _columns(head: bytes) -> NDArray[np.int64]:
    """The columns before the payload, as the header names them."""
    names = head.partition(b"\n")[0].decode("ascii", "ignore").strip().lower().split(",")[3:]
    before = names[: names.index("d1")] if "d1" in names else list(NAMES)
    further = [NAMES[name.strip()] for name in before if name.strip() in NAMES]
    return np.array([STAMP, IDENTIFIER, IS_EXTENDED, *further], np.int64)


def read(path: Path) -> Frames:
    """All classic data frames of a log of SavvyCAN; LogError if it is none."""
    text = np.fromfile(path, np.uint8)
    return tx.read(path, text, LIKE, parse, _columns(text[:HEAD_BYTES].tobytes()))
