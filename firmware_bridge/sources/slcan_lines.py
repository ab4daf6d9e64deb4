"""The lines of an slcan adapter (Lawicel's ASCII protocol), parsed in bulk.

One line per frame, ended by CR: t or r (remote) with an identifier of 3 hex digits, T or R with 8,
then the length, two digits per data byte, and, if switched on, four digits of time stamp in
milliseconds, rolling over at 60,000.  Answers of the adapter stand in between: CR, and BEL for a
refused command.

A line is a frame only if it is one to its last character.  t, T, r, R are no hex digits: where a
damaged CR joins two lines, the second is still found by its first letter.  A digit that becomes
another digit is all that can pass; the end-to-end CRC of the payload is the guard against that.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, inlined, kernel
from firmware_bridge.sources.text import CR, HEX, Rows

ROLL_OVER_US = 60_000_000
MAX_LINE = 64  # bytes kept while no CR comes; the longest line has 31
SWITCH = 4  # so many frames in a row with (without) stamps tell that they are on (off)

REASONS = ("bad_line", "remote_frame", "fd_frame", "adapter_error")
BAD, REMOTE, FD, ADAPTER = 0, 1, 2, 3
OK = -1
BEL = 7

KIND = np.zeros(256, np.uint8)  # what a line is, by its first letter
STANDARD, EXTENDED, REMOTE_KIND, FD_KIND = 1, 2, 4, 8
for _letter, _kind in (
    ("t", STANDARD), ("T", EXTENDED), ("r", STANDARD | REMOTE_KIND), ("R", EXTENDED | REMOTE_KIND),
    ("d", FD_KIND), ("D", FD_KIND), ("b", FD_KIND), ("B", FD_KIND),
):  # fmt: skip
    KIND[ord(_letter)] = _kind


@inlined
def _hex(text: NDArray[np.uint8], first: Integer, count: Integer) -> Integer:
    """Number of `count` hex digits; -1 if one is none."""
    value, seen = np.int64(0), np.int64(0)
    for k in range(first, first + count):
        value = value * 16 + HEX[text[k]]
        seen |= HEX[text[k]]
    return value if seen < 16 else -1


@inlined
def _shape(
    text: NDArray[np.uint8], start: Integer, end: Integer
) -> tuple[Integer, Integer, Integer]:
    """Identifier, length and whether a stamp follows (0, 1) of a line; the identifier -1 if bad."""
    kind = KIND[text[start]]
    digits = 8 if kind & EXTENDED else 3
    if not kind & (STANDARD | EXTENDED) or end - start < digits + 2:
        return -1, 0, 0
    can_id = _hex(text, start + 1, digits)
    length = HEX[text[start + 1 + digits]]
    limit = 1 << 29 if kind & EXTENDED else 1 << 11
    if can_id < 0 or can_id >= limit or length > 8:
        return -1, 0, 0
    rest = end - start - digits - 2 - (0 if kind & REMOTE_KIND else 2 * length)
    if rest not in (0, 4):
        return -1, 0, 0
    return can_id | (fr.EXTENDED if kind & EXTENDED else 0), length, rest // 4


@inlined
def _agrees(state: NDArray[np.int64], stamped: Integer) -> bool:
    """Whether a frame has a stamp just when the others have; changes its mind after SWITCH."""
    state[1] = state[1] + 1 if stamped != state[0] else 0
    if state[1] >= SWITCH:
        state[0], state[1] = stamped, 0
    return bool(stamped == state[0])


@inlined
def _frame(
    text: NDArray[np.uint8], start: Integer, end: Integer, rows: Rows, n: Integer,
    state: NDArray[np.int64],
) -> Integer:  # fmt: skip
    """Parse text[start:end] into row n (changed in place); OK or why not."""
    can_id, length, stamped = _shape(text, start, end)
    if can_id < 0:
        return BAD
    remote = KIND[text[start]] & REMOTE_KIND
    first = end - 4 * stamped - (0 if remote else 2 * length)
    good, value = True, np.int64(0)
    rows.data[n] = 0
    for k in range(0 if remote else length):
        value = HEX[text[first + 2 * k]] * 16 + HEX[text[first + 2 * k + 1]]
        good &= value < 256 and HEX[text[first + 2 * k + 1]] < 16
        rows.data[n, k] = value & 0xFF
    milliseconds = _hex(text, end - 4, 4) if stamped else 0
    if not good or milliseconds < 0 or milliseconds >= ROLL_OVER_US // 1000:
        return BAD
    if not _agrees(state, stamped):
        return BAD
    if remote:
        return REMOTE
    rows.can_id[n], rows.length[n], rows.t_us[n] = can_id, length, milliseconds * 1000
    return OK


@inlined
def _other(text: NDArray[np.uint8], start: Integer, end: Integer) -> Integer:
    """Why a line that begins with no letter of a classic frame is none."""
    if not KIND[text[start]] & FD_KIND or end - start < 5:
        return BAD
    for k in range(start + 1, end):
        if HEX[text[k]] > 15:
            return BAD
    return FD


@inlined
def _line(
    text: NDArray[np.uint8], start: Integer, end: Integer, rows: Rows, n: Integer,
    state: NDArray[np.int64], counts: NDArray[np.int64],
) -> Integer:  # fmt: skip
    """One more frame in row n (1), or none (0); what is refused is counted."""
    if KIND[text[start]] & (STANDARD | EXTENDED):
        result = _frame(text, start, end, rows, n, state)
    else:
        result = _other(text, start, end)
    if result >= 0:
        counts[result] += 1
    if result != BAD:
        return 1 if result == OK else 0
    last = end - 1
    while last > start and not KIND[text[last]] & (STANDARD | EXTENDED):
        last -= 1
    if last == start:
        return 0
    result = _frame(text, last, end, rows, n, state)
    if result > BAD:
        counts[result] += 1
    return 1 if result == OK else 0


@kernel
def parse(
    text: NDArray[np.uint8], rows: Rows, ends: NDArray[np.int64], state: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> tuple[Integer, Integer]:  # fmt: skip
    """Frames found and bytes used; rows, ends, state [stamped, doubts], counts are changed.

    text (bytes,); ends (frames,); state (2,); counts (reasons,).
    """
    n, start = 0, 0
    for end in range(len(text)):
        if text[end] != CR and text[end] != BEL:
            continue
        if text[end] == BEL:
            counts[BAD if end > start else ADAPTER] += 1
        elif end > start:
            ends[n] = end + 1
            n += _line(text, start, end, rows, n, state, counts)
        start = end + 1
    return n, start


class Decoder:
    """Turns pieces of the byte stream into frames; a line may be cut anywhere.

    stamped: whether time stamps are expected; four frames in a row that say otherwise are believed.
    `t_us` is the adapter's stamp, 0 without.
    """

    def __init__(self, stamped: bool = False) -> None:
        self._pending = b""
        self._state = np.array([stamped, 0], np.int64)

    @property
    def stamped(self) -> bool:
        """Whether frames carry a time stamp."""
        return bool(self._state[0])

    def push(self, piece: bytes) -> Frames:
        """The frames that became complete; `refused` as in REASONS."""
        return self.decode(piece)[0]

    def decode(self, piece: bytes) -> tuple[Frames, NDArray[np.int64]]:
        """As `push`; and behind which byte of the piece each frame was complete, int64 (n,)."""
        kept, text = len(self._pending), self._pending + piece
        room = text.count(b"\r") + 1
        out, ends = fr.empty(room), np.empty(room, np.int64)
        rows = Rows(out.t_us, out.channel, out.can_id, out.length, out.data)
        counts = np.zeros(len(REASONS), np.int64)
        n, used = parse(np.frombuffer(text, np.uint8), rows, ends, self._state, counts)
        self._pending = text[used:]
        if len(self._pending) > MAX_LINE:  # "?": what is left of it is no line
            self._pending = b"?" + self._pending[-MAX_LINE + 1 :]
        frames = out[:n]
        fr.add_counts(frames.refused, dict(zip(REASONS, counts.tolist(), strict=True)))
        return frames, ends[:n] - kept
