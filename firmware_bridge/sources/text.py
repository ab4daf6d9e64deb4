"""What the readers of text logs share: whole lines, strict numbers, and rows to fill.

A line is a frame only if it is one to its last character: lengths must agree, digits must be there
in their full number, nothing may follow.  A flipped digit that yields another digit is therefore
all that can pass; the end-to-end CRC of the payload is the guard against that.  Every line that is
no data frame is counted under its reason.  A last line without a newline has been cut and is left
out.  A damaged newline joins two lines: the first is lost, the second is still found.  The order
of the lines guards the stamps: one that lies outside its neighbours by 0.1 s is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, inlined
from firmware_bridge.sources.errors import LogError

REASONS = ("bad_line", "remote_frame", "fd_frame", "error_frame", "other_event", "truncated")
BAD, REMOTE, FD, ERROR, OTHER, TRUNCATED = 0, 1, 2, 3, 4, 5
OK, NOTHING = -1, -2  # a frame; a blank, header or comment line
NEWLINE, CR, TAB, SPACE, DOT = 10, 13, 9, 32, 46
EXTENDED = 0x8000_0000
STRAY_US = 100_000  # logs of several channels may be out of order by less
FRAMES_PER_LINE = 2  # a damaged newline joins two lines

HEX = np.full(256, 255, np.int64)
for _k, _c in enumerate(b"0123456789abcdef"):
    HEX[_c] = HEX[ord(chr(_c).upper())] = _k


class Rows(NamedTuple):
    """The columns of `Frames`, as kernels take them; changed in place."""

    t_us: NDArray[np.int64]
    channel: NDArray[np.uint8]
    can_id: NDArray[np.uint32]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]


@inlined
def skip(text: NDArray[np.uint8], pos: Integer, end: Integer) -> Integer:
    """Next position in text (bytes,) that is no blank."""
    while pos < end and (text[pos] == SPACE or text[pos] == TAB or text[pos] == CR):
        pos += 1
    return pos


@inlined
def token(text: NDArray[np.uint8], pos: Integer, end: Integer) -> tuple[Integer, Integer]:
    """Bounds of the next word in text (bytes,) between blanks; empty at the end of the line."""
    first = skip(text, pos, end)
    last = first
    while last < end and text[last] != SPACE and text[last] != TAB and text[last] != CR:
        last += 1
    return first, last


@inlined
def number(text: NDArray[np.uint8], first: Integer, last: Integer, base: Integer) -> Integer:
    """The word of text (bytes,) as a number of 1 to 10 digits; -1 if it is none."""
    value: Integer = 0
    if last <= first or last - first > 10:
        return -1
    for k in range(first, last):
        if HEX[text[k]] >= base:
            return -1
        value = value * base + HEX[text[k]]
    return value


@inlined
def micro(
    text: NDArray[np.uint8], pos: Integer, end: Integer, dotted: bool
) -> tuple[Integer, Integer]:
    """A decimal number times 1e6, rounded, and the position behind it; -1 if malformed.

    text (bytes,).  dotted: whether it must have a fraction.
    """
    whole: Integer = 0
    fraction: Integer = 0
    first = pos
    while pos < end and 48 <= text[pos] <= 57:
        whole, pos = whole * 10 + np.int64(text[pos] - 48), pos + 1
    if pos == first or pos - first > 12:
        return 0, -1
    if pos == end or text[pos] != DOT:
        return whole * 1_000_000, -1 if dotted else pos
    pos, first, scale = pos + 1, pos + 1, 100_000_000
    while pos < end and 48 <= text[pos] <= 57:
        fraction, scale, pos = fraction + scale * np.int64(text[pos] - 48), scale // 10, pos + 1
    return whole * 1_000_000 + (fraction + 500) // 1000, pos if pos > first else -1


@inlined
def is_fd_length(size: Integer) -> bool:
    """Whether a CAN FD frame may hold so many bytes."""
    return bool(0 <= size <= 8 or size in (12, 16, 20, 24, 32, 48, 64))


@inlined
def word(text: NDArray[np.uint8], first: Integer, last: Integer) -> Integer:
    """The first four letters of a word of text (bytes,) in lower case, as `code` numbers them."""
    value: Integer = 0
    for k in range(min(last - first, 4)):
        value = value * 256 + np.int64(text[first + k] | 32)
    return value


def code(letters: str) -> int:
    """The number of a word's first four letters."""
    return int.from_bytes(letters.lower().encode()[:4], "big")


@inlined
def counted(result: Integer, is_first: bool, counts: NDArray[np.int64]) -> Integer:
    """1 for a frame; else 0, and the reason is counted in place in counts (reasons,).

    What is bad in the rest of a joined line was counted with its beginning.
    """
    if result >= 0 and (is_first or result != BAD):
        counts[result] += 1
    return 1 if result == OK else 0


def scan(text: NDArray[np.uint8], parse: Callable[..., Any], *options: Any) -> tuple[Frames, int]:
    """All frames of a text log, and how many lines are malformed.

    parse(text, starts, stops, rows, counts, *options) is the kernel that fills rows (Rows) and
    counts (REASONS,), and returns the number of frames.
    """
    stops = np.flatnonzero(text == NEWLINE)
    starts = np.concatenate([np.zeros(1, np.int64), stops + 1])
    for longest in (fr.MAX_LENGTH, fr.MAX_FD_LENGTH):
        out = fr.empty(FRAMES_PER_LINE * len(stops), longest)
        rows = Rows(out.t_us, out.channel, out.can_id, out.length, out.data)
        counts = np.zeros(len(REASONS), np.int64)
        n = parse(text, starts[:-1], stops, rows, counts, *options)
        if not counts[FD]:  # all of them have room
            break
    counts[TRUNCATED] += starts[-1] < len(text)
    frames = fr.narrowed(out[:n])
    fr.add_counts(frames.refused, dict(zip(REASONS, counts.tolist(), strict=True)))
    return frames, int(counts[BAD])


def read(
    path: Path, text: NDArray[np.uint8], like: str, parse: Callable[..., Any], *options: Any
) -> Frames:
    """`scan` of text (bytes,), but LogError where all lines are bad; like: what one should be."""
    frames, n_bad = scan(text, parse, *options)
    if len(frames) == 0 and n_bad:
        raise LogError(f"{path}: no line looks like {like}; give the file its right suffix")
    return without_stray_stamps(frames)


def without_stray_stamps(frames: Frames) -> Frames:
    """The frames but those whose stamp alone lies outside its neighbours, which are in order.

    One digit makes such a stamp; taken for true it would make all that follows come too late.
    """
    t_us = frames.t_us
    if len(t_us) < 2:
        return frames
    before = np.concatenate([np.minimum(t_us[:1], t_us[1:2]), t_us[:-1]])
    after = np.concatenate([t_us[1:], np.maximum(t_us[-1:], t_us[-2:-1])])
    outside = (t_us > after + STRAY_US) | (t_us < before - STRAY_US)
    stray = outside & (before <= after)
    if not stray.any():
        return frames
    kept = frames[~stray]
    fr.add_counts(kept.refused, frames.refused | {"stray_stamp": int(stray.sum())})
    return kept
