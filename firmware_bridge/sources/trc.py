"""TRC logs (PEAK-System), versions 1.0 to 2.1, parsed in bulk over the bytes.

Comment lines (;) name version, start and columns; then one event per line, one letter per column:

    N number  O offset, ms  T type  B bus  I identifier, hex  d Rx or Tx  R reserved
    l length or L length code  D bytes, hex

An identifier of 4 digits is standard, of 7 or 8 extended.  Bus 1 is channel 0.  Stamps count from
the start named in the header (1.1 and later; days, to about 10 us, so the origin is no better),
else from 0.  They are as coarse as the file: 1 ms in version 1.0, 0.1 ms in 1.1 to 1.3, 1 us in
2.x; what is read is exact to that step.
"""

from __future__ import annotations

import datetime
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.frames import EXTENDED, Frames, add_counts
from firmware_bridge.jit import Integer, inlined, kernel
from firmware_bridge.sources import text as tx
from firmware_bridge.sources.text import BAD, ERROR, FD, NOTHING, OK, OTHER, REMOTE, Rows

LIKE = "'1) 1.5 Rx 0120 2 00 11'"
HEAD_BYTES, SAMPLE_BYTES = 8192, 1 << 17
COLUMNS = {
    "1.0": b"NOILD", "1.1": b"NOTILD", "1.2": b"NOBTILD", "1.3": b"NOBTIRLD", "2.0": b"NOTIdlD",
    "2.1": b"NOTBIdRLD",
}  # fmt: skip
KNOWN = re.compile(rb"[NOTBIdR]*[lL]D")
DAY_ZERO = datetime.datetime(1899, 12, 30, tzinfo=datetime.UTC)

NUMBER, OFFSET, TYPE, BUS, IDENTIFIER, DIRECTION, BYTES = b"NOTBIdD"
LENGTHS = (ord("l"), ord("L"))
PARENTHESIS, SEMICOLON = 41, 59
RX, TX = tx.code("Rx"), tx.code("Tx")
DATA_TYPES = tuple(tx.code(name) for name in ("DT", "Rx", "Tx"))
FD_TYPES = tuple(tx.code(name) for name in ("FD", "FB", "FE", "BI"))  # plain, BRS, ESI, both
OTHER_TYPES = tuple(tx.code(name) for name in ("ST", "EC", "EV", "Warn"))
ERROR_TYPES = tuple(tx.code(name) for name in ("ER", "Error"))
RTR, RR, ERROR_WORD = tx.code("RTR"), tx.code("RR"), tx.code("ERROR")


@inlined
def _kind(letters: Integer) -> Integer:
    """OK if lines of this type hold data, else why not."""
    if letters in DATA_TYPES:
        return OK
    if letters in FD_TYPES:
        return FD
    if letters == RR:
        return REMOTE
    if letters in ERROR_TYPES:
        return ERROR
    return OTHER if letters in OTHER_TYPES else BAD


@inlined
def _identifier(text: NDArray[np.uint8], first: Integer, last: Integer) -> Integer:
    """Identifier, bit 31 set if extended; -1 if malformed."""
    size = last - first
    value = tx.number(text, first, last, 16)
    if size == 4 and value <= 0x7FF:
        return value
    return value | EXTENDED if size in (7, 8) and 0 <= value <= 0x1FFF_FFFF else -1


@inlined
def _bytes(
    text: NDArray[np.uint8], pos: Integer, end: Integer, size: Integer, data: NDArray[np.uint8]
) -> tuple[Integer, Integer]:
    """Read `size` bytes and nothing more into data; OK or BAD, and where to go on."""
    data[:] = 0
    for k in range(size):
        first = tx.skip(text, pos, end)
        pos = min(first + 2, end)
        value = tx.number(text, first, pos, 16)
        if value < 0 or pos != first + 2 or text[first - 1] > tx.SPACE:
            return BAD, end
        data[k] = value
    first = tx.skip(text, pos, end)
    if first == end:
        return OK, end
    while first < end and not 48 <= text[first] <= 57:  # a line joined to this one
        first += 1
    return BAD, first


@inlined
def _line(  # noqa: PLR0911  each return names what is wrong with the line
    text: NDArray[np.uint8], pos: Integer, end: Integer, columns: NDArray[np.uint8], rows: Rows,
    k: Integer,
) -> tuple[Integer, Integer]:  # fmt: skip
    """Parse text[pos:end] into row k (changed in place); OK or why not, and where to go on."""
    first = tx.skip(text, pos, end)
    if first == end or (text[first] == SEMICOLON and not 48 <= text[min(first + 1, end - 1)] <= 57):
        return NOTHING, end  # a ; before a digit was a digit once
    rows.channel[k], size, last = 0, 0, first
    for column in columns:
        first, last = tx.token(text, last, end)
        if column == BYTES:
            break
        value: Integer = 0
        if column == NUMBER:
            marked = last > first and text[last - 1] == PARENTHESIS
            value = tx.number(text, first, last - 1 if marked else last, 10)
        elif column == OFFSET:
            t_ns, behind = tx.micro(text, first, last, False)
            rows.t_us[k], value = (t_ns + 500) // 1000, -1 if behind != last else 0
        elif column == TYPE:
            kind = _kind(tx.word(text, first, last))
            if kind != OK:
                return kind, end
        elif column == BUS:
            value = tx.number(text, first, last, 10) - 1
            rows.channel[k] = max(value, 0)
        elif column == IDENTIFIER:
            if last - first == 8 and tx.number(text, first, last, 16) == 0xFFFF_FFFF:
                return OTHER, end  # warning of version 1.0
            value = _identifier(text, first, last)
            rows.can_id[k] = max(value, 0)
        elif column == DIRECTION:
            value = 0 if tx.word(text, first, last) in (RX, TX) else -1
        elif column in LENGTHS:
            size = value = tx.number(text, first, last, 10)
            rows.length[k] = max(min(size, 8), 0)
        if value < 0 or first == last:
            return BAD, end
    letters = tx.word(text, first, last)
    if letters in (RTR, ERROR_WORD):
        return REMOTE if letters == RTR else ERROR, end
    if size > 8:
        return FD, end
    return _bytes(text, first, end, size, rows.data[k])


@kernel
def parse(
    text: NDArray[np.uint8], starts: NDArray[np.int64], stops: NDArray[np.int64], rows: Rows,
    counts: NDArray[np.int64], columns: NDArray[np.uint8],
) -> Integer:  # fmt: skip
    """Parse all lines into rows; the number of frames.  Changed in place: rows, counts.

    text (bytes,); starts, stops (lines,); counts (reasons,); columns (columns,).
    """
    n = 0
    for i in range(len(starts)):
        pos, first = starts[i], True
        while pos < stops[i]:
            result, after = _line(text, pos, stops[i], columns, rows, n)
            n += tx.counted(result, first, counts)
            pos, first = after if first else stops[i], False
    return n


def _start_us(head: str) -> tuple[int, bool]:
    """Microseconds since 1970 of the log's start, 0 if unknown, and whether the date is damaged."""
    named = re.search(r"^;\$STARTTIME=(.*)$", head, re.MULTILINE)
    if not named:
        return 0, "$COLUMNS" in head  # version 1.0 has none
    try:
        start = DAY_ZERO + datetime.timedelta(days=float(named[1]))
    except (ValueError, OverflowError):
        return 0, True
    return round(start.timestamp() * 1e6), False


def _columns(head: str, text: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The stated columns; if they yield no frame, those that fit best (a damaged header)."""
    stated = re.search(r"^;\$COLUMNS=([\w,]+)", head, re.MULTILINE)
    version = re.search(r"^;\$FILEVERSION=(\d\.\d)", head, re.MULTILINE)
    first = COLUMNS.get(version[1] if version else "1.0", COLUMNS["1.0"])
    letters = stated[1].replace(",", "").encode() if stated else b""
    if KNOWN.fullmatch(letters) and all(letters.count(letter) == 1 for letter in b"OID"):
        first = letters
    choices = [np.frombuffer(letter, np.uint8) for letter in (first, *COLUMNS.values())]
    sample = text[: HEAD_BYTES + SAMPLE_BYTES]
    if len(tx.scan(sample, parse, choices[0])[0]):
        return choices[0]
    return max(choices, key=lambda columns: len(tx.scan(sample, parse, columns)[0]))


def read(path: Path) -> Frames:
    """All classic data frames of a TRC log; LogError if it is none."""
    text = np.fromfile(path, np.uint8)
    head = text[:HEAD_BYTES].tobytes().decode("ascii", "replace").replace("\r", "")
    start_us, damaged = _start_us(head)
    frames = tx.read(path, text, LIKE, parse, _columns(head, text))
    frames.t_us[:] += start_us
    add_counts(frames.refused, {"bad_date": int(damaged)})
    return frames
