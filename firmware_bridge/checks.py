"""Which frame is admitted: identifier, length, CRC, alive counter, order, availability.

Every refusal has a reason and a counter.  A counter of 2^b values cannot see a loss of a multiple
of 2^b frames, so it is judged together with the time since the message's last good frame:

    step = (counter - last) mod 2^b:  step 0 within 1.5 periods is repeated; n > 1 steps need n / 2
    periods, else the frame is a late one (n near 2^b) or somebody else's
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import bits, e2e
from firmware_bridge.jit import Integer, Record, Records, inlined

REASONS = (
    "unknown_id",  # not a declared message: foreign traffic
    "wrong_length",
    "crc",
    "counter_repeat",  # a frame seen before
    "counter_jump",  # accepted, but frames before it were lost
    "out_of_order",  # older than the frame before it, or too soon for its counter
    "not_available",  # a wanted signal is absent, NaN or out of its declared range
    "other_page",  # a multiplexed message that carries other signals
    "incomplete_cycle",  # cycles of which a message never came
    "gap",  # accepted samples that do not continue the one before
    "silent",  # instants without a sample because a message was silent for too long
    "unpaired",  # instants before the first or after the last frame of another message
)
OK = -1
UNKNOWN_ID, WRONG_LENGTH, CRC, COUNTER_REPEAT, COUNTER_JUMP, OUT_OF_ORDER = 0, 1, 2, 3, 4, 5
NOT_AVAILABLE, OTHER_PAGE, INCOMPLETE_CYCLE, GAPS, SILENT, UNPAIRED = 6, 7, 8, 9, 10, 11

ZERO, LINEAR, MEAN = 0, 1, 2  # how a role runs between its samples

MESSAGE = np.dtype(
    [
        ("can_id", np.uint32),
        ("channel", np.int16),  # -1: any
        ("length", np.uint8),
        ("crc_byte", np.int8),  # -1: no CRC
        ("data_id", np.uint16),
        ("counter", np.int16),  # row of its layout, -1: no alive counter
        ("counter_mask", np.uint64),
        ("first_role", np.int16),
        ("n_roles", np.int16),
        ("period_us", np.int64),
        ("late_us", np.int64),  # 1.5 periods
        ("offset_us", np.int64),
        ("limit_us", np.int64),  # silent for longer than this: a gap
    ]
)
ROLE = np.dtype(
    [
        ("layout", np.int16),
        ("column", np.int16),
        ("hold", np.uint8),
        ("factor", np.float64),
        ("offset", np.float64),
        ("table_first", np.int32),
        ("table_count", np.int32),  # 0: factor and offset
    ]
)
LAST = np.dtype(
    [
        ("t_us", np.int64),
        ("counter", np.int64),
        ("seen", np.bool_),
        ("good", np.int64),  # frames admitted so far
        ("gap_us", np.int64),  # longest time between two of them, since somebody set it to 0
        ("refused", np.int64, len(REASONS)),
    ]
)


class Plan(NamedTuple):
    """What does not change while frames run through: declared messages and roles.

    messages: MESSAGE (m,); roles: ROLE (r,), grouped by message; layouts, codes: see
    `firmware_bridge.bits`; tables: float64 (2, t), x and y of all role tables one after the other.

    Kernels unpack it once at their door: numba counts references each time a field is taken out,
    which took half of the time per frame.
    """

    messages: Records
    roles: Records
    layouts: Records
    codes: NDArray[np.uint64]
    tables: NDArray[np.float64]


@inlined
def find_message(messages: Records, can_id: np.uint32, channel: np.uint8) -> Integer:
    """Index of the declared message with this identifier and channel; -1 if there is none."""
    for m in range(len(messages)):
        row = messages[m]
        if row.can_id == can_id and (row.channel < 0 or row.channel == channel):
            return m
    return -1


@inlined
def _refuse(last: Record, reason: Integer, counts: NDArray[np.int64]) -> None:
    """Count a refusal for the message and for all of them."""
    last.refused[reason] += 1
    counts[reason] += 1


@inlined
def check_sequence(
    row: Record, last: Record, t_us: Integer, counter: Integer, counts: NDArray[np.int64]
) -> Integer:
    """OK or the reason against this frame, by its counter (-1: none) and time stamp.

    counts (reasons,): changed in place.
    """
    if not last.seen:
        return OK
    dt = t_us - last.t_us
    if counter >= 0:
        step = (counter - last.counter) & np.int64(row.counter_mask)
        if dt <= row.late_us and step == 0:
            return COUNTER_REPEAT
        if step > 1 and 3 * dt < step * row.late_us:
            return OUT_OF_ORDER
        if dt > 0 and step != 1:
            _refuse(last, COUNTER_JUMP, counts)
    return OUT_OF_ORDER if dt <= 0 else OK


@inlined
def interpolate(x: float, tables: NDArray[np.float64], first: Integer, count: Integer) -> float:
    """`numpy.interp` of one finite value in the table of `count` points from `first` on.

    tables (2, points): x and y of all tables, each in the units of its own.
    """
    low, high = first, first + count - 1
    if x <= tables[0, low]:
        return tables[1, low]
    if x >= tables[0, high]:
        return tables[1, high]
    while high - low > 1:
        middle = (low + high) // 2
        if tables[0, middle] <= x:
            low = middle
        else:
            high = middle
    slope = (tables[1, high] - tables[1, low]) / (tables[0, high] - tables[0, low])
    return tables[1, low] + slope * (x - tables[0, low])


@inlined
def read_roles(
    row: Record,
    roles: Records,
    layouts: Records,
    codes: NDArray[np.uint64],
    tables: NDArray[np.float64],
    word: np.uint64,
    values: NDArray[np.float64],
) -> Integer:
    """SI values of the message's roles into values (roles,), changed in place; OK or reason."""
    for i in range(row.n_roles):
        role = roles[row.first_role + i]
        if not bits.selected(word, layouts, role.layout, codes):
            return OTHER_PAGE
        x = bits.decode_one(word, layouts, role.layout, codes)
        if not np.isfinite(x):
            return NOT_AVAILABLE
        if role.table_count:
            values[i] = interpolate(x, tables, role.table_first, role.table_count)
        else:
            values[i] = role.factor * x + role.offset
    return OK


@inlined
def admit(
    row: Record,
    last: Record,
    roles: Records,
    layouts: Records,
    codes: NDArray[np.uint64],
    tables: NDArray[np.float64],
    t_us: Integer,
    length: Integer,
    word: np.uint64,
    values: NDArray[np.float64],
    counts: NDArray[np.int64],
) -> Integer:
    """Check one frame of the message `row`; OK, or the reason against it (counted).

    Changed in place: last (LAST of this message), values (its roles, SI), counts.  A frame whose
    values are not available still moves the counter on: it was received.
    """
    if length != row.length:
        _refuse(last, WRONG_LENGTH, counts)
        return WRONG_LENGTH
    if row.crc_byte >= 0:
        expected = e2e.crc8(word, row.length, row.crc_byte, row.data_id)
        if expected != (word >> np.uint64(8 * row.crc_byte)) & np.uint64(0xFF):
            _refuse(last, CRC, counts)
            return CRC
    counter = np.int64(-1)
    if row.counter >= 0:
        counter = np.int64(bits.raw_bits(word, layouts[row.counter]))
    reason = check_sequence(row, last, t_us, counter, counts)
    if reason == OK:
        if last.seen:
            last.gap_us = max(last.gap_us, t_us - last.t_us)
        last.good += 1
        last.t_us, last.counter, last.seen = t_us, counter, True
        reason = read_roles(row, roles, layouts, codes, tables, word, values)
    if reason != OK:
        _refuse(last, reason, counts)
    return reason
