"""A second sender with the same identifier: its message comes faster than it is declared.

Each frame fills a bucket by one, and time empties it by 1.25 frames per period T:

    level <- max(0, level + 1 - 1.25 dt / T),   a second sender:  level > clip(75 ms / T, 3, 75)

It does not overflow: two senders fill it in about 100 ms, and it is empty 0.3 s after the second
one has ended.  A sender or an adapter that was held up sends what is late at
once: a silence gives credit for the frames that it owes.  From an overflow on the message is
refused until 0.5 s after the last one: nobody can tell which sender is right.  All frames count,
also those that a CRC or counter would refuse.  No clock is asked: pieces of any size give the same.

Of a message for which no channel is declared the first channel that brings it is taken, and what
other channels bring of it is refused: a gateway repeats it there late, or it is another machine's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import frames as fr
from firmware_bridge.checks import find_message
from firmware_bridge.frames import Frames
from firmware_bridge.jit import Integer, Record, Records, inlined, kernel

LEAK = 1.25
FULL_US, LEAST_FULL, MOST_FULL = 75_000.0, 3.0, 75.0
SILENCE = 1.5  # periods
CREDIT_US = 2_000_000.0  # what a silence gives is forgotten with this time constant
HOLD_US = 500_000
REASON, OTHER_CHANNEL = "too_fast", "other_channel"

SENDER = np.dtype(
    [
        ("can_id", np.uint32),
        ("channel", np.int16),  # -1: any
        ("period_us", np.float64),
        ("full", np.float64),
        ("level", np.float64),
        ("credit", np.float64),  # frames that are owed
        ("last_us", np.int64),
        ("until_us", np.int64),  # refused before this time
        ("other_until_us", np.int64),  # another channel brings it too, up to this time
        ("seen", np.bool_),
    ]
)


@inlined
def _fill(record: Record, t_us: Integer) -> None:
    """One frame more in the bucket."""
    periods = (t_us - record.last_us) / record.period_us if record.seen else 1.0
    if periods < 0.0 and t_us < record.last_us - HOLD_US:  # the clock was set back
        record.until_us, record.level, periods = t_us, 0.0, 1.0
    periods = max(periods, 0.0)
    record.credit *= max(0.0, 1.0 - periods * record.period_us / CREDIT_US)
    if periods > SILENCE:
        record.credit = min(record.credit + periods - 1.0, CREDIT_US / record.period_us)
    record.level = min(max(0.0, record.level + 1.0 - LEAK * periods), record.full + 1.0)
    used = min(record.credit, record.level)
    record.level -= used
    record.credit -= used
    record.last_us, record.seen = t_us, True


@kernel
def mark(
    declared: Records,
    senders: Records,
    t_us: NDArray[np.int64],
    channel: NDArray[np.uint8],
    can_id: NDArray[np.uint32],
    keep: NDArray[np.bool_],
) -> tuple[int, int]:
    """Set keep (n,) to False where a frame is refused; how many are too fast, and of others.

    declared (m,): as the senders (m,), which are changed in place.
    """
    refused = others = 0
    for i in range(len(t_us)):
        m = find_message(declared, can_id[i], channel[i])
        if m < 0:
            continue
        sender = senders[m]
        if sender.channel < 0:
            sender.channel = channel[i]
        if sender.channel != channel[i]:
            sender.other_until_us = t_us[i] + HOLD_US
            keep[i] = False
            others += 1
            continue
        _fill(sender, t_us[i])
        if sender.level > sender.full:
            sender.until_us = t_us[i] + HOLD_US
        if t_us[i] < sender.until_us:
            keep[i] = False
            refused += 1
    return refused, others


class Senders:
    """Refuses the frames of messages that more than one sender seems to send.

    messages: MESSAGE (m,) of the assembler's plan, or anything with its can_id, channel, period_us.
    """

    def __init__(self, messages: Records) -> None:
        self._declared, self._senders = messages, np.zeros(len(messages), SENDER)
        for name in ("can_id", "channel", "period_us"):
            self._senders[name] = messages[name]
        self._senders["full"] = np.clip(FULL_US / messages["period_us"], LEAST_FULL, MOST_FULL)
        self._last_us = 0

    def push(self, frames: Frames) -> Frames:
        """The frames that may be believed; what was refused is counted by reason."""
        keep = np.ones(len(frames), np.bool_)
        columns = frames.t_us, frames.channel, frames.can_id
        refused, others = mark(self._declared, self._senders, *columns, keep)
        if len(frames):
            self._last_us = int(frames.t_us[-1])
        if not refused + others:
            return frames
        kept = frames[keep]
        fr.add_counts(kept.refused, frames.refused)
        fr.add_counts(kept.refused, {REASON: int(refused), OTHER_CHANNEL: int(others)})
        return kept

    @property
    def doubted(self) -> NDArray[np.bool_]:
        """Which messages are being refused, bool (m,), at the last frame seen."""
        return np.asarray(self._senders["until_us"] > self._last_us)

    @property
    def channels(self) -> NDArray[np.int16]:
        """The channel that each message is taken from, (m,), where others bring it too; else -1."""
        doubled = self._senders["other_until_us"] > self._last_us
        return np.where(doubled, self._senders["channel"], -1).astype(np.int16)
