"""Stamps of a log put right where the bus's own timing tells how: reordered frames, and bursts.

An adapter that is asked every 20 ms delivers what came since with one stamp.  A frame of such a
burst was sent behind the burst before (b) and not behind its own stamp (s).  Of a message with a
steady period T, frame i of a run was sent at a + i T, so

    b_i < a + i T <= s_i   for all i:   max(b_i - i T) < a <= min(s_i - i T)

T is the slope through the middles (b_i + s_i) / 2; the middle of what is left for a is taken, half
its width is what stays unknown.  A run that fits no period (a lost frame, a message that is sent on
events) is halved until its parts do, with the period of the longest, or are too short: those keep
their stamps.  Where many stamps go back the frames were delivered out of order, and are sorted; a
lone one is damaged.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames

BURST = 4  # frames of one channel with one stamp: no bus sends them at once
BURSTS_SHARE = 0.5  # of a channel's frames, before its adapter is known to deliver in bursts
LEAST_SILENCE_US = 3_000  # before a burst; stamps of 1 ms are coarse, not late
LONGEST_RUN, SHORTEST_RUN = 1000, 16  # frames of one message; clocks drift, a line does not
LONG_RUN = 400  # what shows its own period: a lost frame would pass for a longer one in less
BREAK = 3.0  # of the median silence, beside 1.5 periods: a gap of the log ends a run
# of the stamps go back: an adapter's habit and no damaged digit
REORDERED_FEWEST, REORDERED_SHARE = 10, 0.01
JITTER_US = 1_000.0  # of a sender
REASONS = ("reordered", "burst_mended", "burst_left")
REORDERED, MENDED, LEFT = REASONS


@dataclass(frozen=True)
class Mended:
    """Frames with better stamps, and what was done.

    late_s: how late the mended stamps were, mean and largest; known_s: within how much they are
    known now, by channel and identifier.
    """

    frames: Frames
    late_s: tuple[float, float]
    known_s: dict[tuple[int, int], float]


class Part(NamedTuple):
    """Frames of a message that have a period: their times, (n,), and the range left for a; us."""

    where: slice
    times_us: NDArray[np.float64]
    period_us: float
    width_us: float


def mend(frames: Frames) -> Mended:
    """Put the stamps right; `refused` counts "reordered", "burst_mended" and "burst_left"."""
    counts, back = dict(frames.refused), int((np.diff(frames.t_us) < 0).sum())
    is_habit = back > max(REORDERED_FEWEST, REORDERED_SHARE * len(frames))
    fr.add_counts(counts, {REORDERED: back if is_habit else 0})
    sorted_frames = fr.by_time(frames) if is_habit else frames
    t_us = sorted_frames.t_us.astype(np.float64)
    late_us, n_left = [np.zeros(0)], 0
    known_s: dict[tuple[int, int], float] = {}
    for channel in np.unique(sorted_frames.channel):
        mine = np.flatnonzero(sorted_frames.channel == channel)
        before_us = _before(sorted_frames.t_us[mine])
        if before_us is None:
            continue
        new_us, width_us = _placed(sorted_frames[mine], before_us)
        known_s |= {(int(channel), i): 0.5e-6 * width for i, width in width_us.items()}
        moved = np.isfinite(new_us)
        late_us.append((t_us[mine] - new_us)[moved])
        n_left += int((~moved).sum())
        t_us[mine[moved]] = new_us[moved]
    late = np.concatenate(late_us)
    fr.add_counts(counts, {MENDED: len(late), LEFT: n_left})
    if len(late):
        rounded = np.rint(t_us).astype(np.int64)
        columns = sorted_frames.channel, sorted_frames.can_id, sorted_frames.length
        sorted_frames = fr.by_time(Frames(rounded, *columns, sorted_frames.data))
    out = sorted_frames[:]
    fr.add_counts(out.refused, counts)
    late_s = (1e-6 * float(late.mean()), 1e-6 * float(late.max())) if len(late) else (0.0, 0.0)
    return Mended(out, late_s, known_s)


def _before(t_us: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Stamp of the burst before each frame's, (n,); None where the frames come in no bursts."""
    first = np.flatnonzero(np.diff(t_us, prepend=t_us[0] - 1))
    sizes = np.diff(np.append(first, len(t_us)))
    in_bursts = sizes[sizes >= BURST].sum()
    silence_us = np.diff(t_us[first], prepend=t_us[0])
    if in_bursts < BURSTS_SHARE * len(t_us) or np.median(silence_us) < LEAST_SILENCE_US:
        return None
    silence_us[0] = np.median(silence_us)
    return np.repeat(t_us[first] - silence_us, sizes).astype(np.float64)


def _placed(
    frames: Frames, before_us: NDArray[np.float64]
) -> tuple[NDArray[np.float64], dict[int, float]]:
    """Times of a channel's frames, NaN where nothing tells, and the range left by identifier."""
    out_us, widths_us = np.full(len(frames), np.nan), dict[int, float]()
    silence_us = float(np.median(frames.t_us - before_us))
    order = np.argsort(frames.can_id, kind="stable")
    ends = np.flatnonzero(np.diff(frames.can_id[order])) + 1
    for places in np.split(order, ends):
        stamps_us = frames.t_us[places].astype(np.float64)
        bounds = before_us[places], stamps_us
        runs = list(_runs(stamps_us, silence_us))
        parts = [part for run in runs for part in _fitted(*bounds, run)]
        if not parts:
            continue
        period_us = max(parts, key=lambda part: len(part.times_us)).period_us
        can_id = int(frames.can_id[places[0]])
        for part in (part for run in runs for part in _fitted(*bounds, run, period_us)):
            out_us[places[part.where]] = part.times_us
            widths_us[can_id] = max(widths_us.get(can_id, 0.0), part.width_us)
    return out_us, widths_us


def _runs(stamps_us: NDArray[np.float64], silence_us: float) -> Iterator[slice]:
    """Pieces of a message without a gap, none of them long."""
    steps_us = np.diff(stamps_us)
    limit_us = BREAK * silence_us + 1.5 * float(np.median(steps_us)) if len(steps_us) else 0.0
    borders = [0, *(np.flatnonzero(steps_us > limit_us) + 1).tolist(), len(stamps_us)]
    for begin, end in itertools.pairwise(borders):
        pieces = np.linspace(begin, end, 1 + -(-(end - begin) // LONGEST_RUN), dtype=int)
        yield from (slice(*piece) for piece in itertools.pairwise(pieces.tolist()))


def _fitted(
    before_us: NDArray[np.float64],
    stamps_us: NDArray[np.float64],
    run: slice,
    period_us: float | None = None,
) -> Iterator[Part]:
    """Parts of a run that have a period; period_us: of those too short to show it themselves."""
    n = run.stop - run.start
    if n < SHORTEST_RUN:
        return
    i = np.arange(n) - 0.5 * (n - 1)
    before, stamps = before_us[run], stamps_us[run]
    slope_us = float(i @ (before + stamps) / (2 * i @ i))
    if period_us is not None and n < LONG_RUN:
        slope_us = period_us
    least_us, most_us = (before - slope_us * i).max(), (stamps - slope_us * i).min()
    if slope_us > 0 and least_us - most_us < 2 * JITTER_US:
        times_us = np.clip(0.5 * (least_us + most_us) + slope_us * i, before, stamps)
        yield Part(run, times_us, slope_us, abs(float(most_us - least_us)))
        return
    middle = (run.start + run.stop) // 2
    for half in (slice(run.start, middle), slice(middle, run.stop)):
        yield from _fitted(before_us, stamps_us, half, period_us)
