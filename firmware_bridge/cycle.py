"""Mode "cycle": all messages belong to one controller cycle, one sample per complete cycle.

Frames of the same cycle carry the same alive counter.  Several cycles may be open at once, because
the bus may delay a frame of low priority into the next cycle; each has a slot, found by its
counter.  Per message frames arrive in order, so once a cycle is complete no older one can be.
Without counters there is one slot, and a cycle lasts half a period from its first frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import checks
from firmware_bridge.jit import Integer, Record, Records, inlined, kernel
from firmware_bridge.samples import GAP, ROW

SLOT = np.dtype(
    [
        ("open", np.bool_),
        ("jump", np.bool_),  # frames were lost before this cycle
        ("mask", np.uint64),  # messages that have arrived
        ("order", np.int64),  # cycles are numbered as they open
        ("first_us", np.int64),  # stamp of the first frame
        ("row_us", np.int64),  # time of the sample
    ]
)
PROGRESS = np.dtype([("opened", np.int64), ("t_us", np.int64), ("started", np.bool_)])


class State(NamedTuple):
    """Everything that a cycle in the making consists of; all arrays are changed in place.

    last: LAST (m,); slots: SLOT (s,); values: float64 (s, columns), constants filled in;
    progress: PROGRESS (1,); scratch: float64 (roles,).
    """

    last: Records
    slots: Records
    values: NDArray[np.float64]
    progress: Records
    scratch: NDArray[np.float64]


@inlined
def _open_slot(slot: Record, progress: Record, t_us: Integer) -> None:
    progress.opened += 1
    slot.open, slot.jump, slot.mask = True, False, np.uint64(0)
    slot.order, slot.first_us, slot.row_us = progress.opened, t_us, t_us


@inlined
def _is_stale(slot: Record, bit: np.uint64, t_us: Integer, lifetime_us: Integer) -> bool:
    """Whether an open slot belongs to an earlier cycle than this frame."""
    return abs(t_us - slot.first_us) > lifetime_us or (slot.mask & bit) != 0


@inlined
def _close_older(slots: Records, order: Integer, counts: NDArray[np.int64]) -> None:
    for k in range(len(slots)):
        if slots[k].open and slots[k].order < order:
            slots[k].open = False
            counts[checks.INCOMPLETE_CYCLE] += 1


@inlined
def _flags(progress: Record, slot: Record, late_us: Integer, counts: NDArray[np.int64]) -> Integer:
    """Flags of the sample that this slot yields."""
    if progress.started:
        if slot.row_us - progress.t_us <= late_us and not slot.jump:
            return ROW
        counts[checks.GAPS] += 1
    return ROW | GAP


@inlined
def _join(
    slot: Record,
    progress: Record,
    bit: np.uint64,
    t_us: Integer,
    jumped: bool,
    lifetime_us: Integer,
    counts: NDArray[np.int64],
) -> None:
    """Note the arrival of a message in the slot of its cycle, opened anew if it is an old one."""
    if slot.open and _is_stale(slot, bit, t_us, lifetime_us):
        slot.open = False
        counts[checks.INCOMPLETE_CYCLE] += 1
    if not slot.open:
        _open_slot(slot, progress, t_us)
    slot.mask |= bit
    slot.jump |= jumped


@inlined
def _complete(
    slots: Records, slot: Record, progress: Record, late_us: Integer, counts: NDArray[np.int64]
) -> Integer:
    """Close a full slot and all older ones; the flags of its sample, -1 if it comes too late."""
    slot.open = False
    _close_older(slots, slot.order, counts)
    if progress.started and slot.row_us <= progress.t_us:
        counts[checks.OUT_OF_ORDER] += 1
        return -1
    flags = _flags(progress, slot, late_us, counts)
    progress.t_us, progress.started = slot.row_us, True
    return flags


@kernel
def push(
    plan: checks.Plan,
    state: State,
    t_us: NDArray[np.int64],
    channel: NDArray[np.uint8],
    can_id: NDArray[np.uint32],
    length: NDArray[np.uint8],
    words: NDArray[np.uint64],
    row_message: Integer,
    lifetime_us: Integer,
    counts: NDArray[np.int64],
    out_t_us: NDArray[np.int64],
    out_values: NDArray[np.float64],
    out_flags: NDArray[np.uint8],
) -> Integer:
    """Run n frames through the assembly; the number of samples written to out_*.

    Changed in place: state, counts (REASONS,), out_* (room for n samples).
    """
    messages, roles, layouts, codes, tables = plan
    last, slots, values, progress, scratch = state
    full = (np.uint64(1) << np.uint64(len(messages))) - np.uint64(1)
    n_out = 0
    for i in range(len(t_us)):
        m = checks.find_message(messages, can_id[i], channel[i])
        if m < 0:
            counts[checks.UNKNOWN_ID] += 1
            continue
        row, jumps = messages[m], counts[checks.COUNTER_JUMP]
        admitted = checks.admit(
            row, last[m], roles, layouts, codes, tables,
            t_us[i], length[i], words[i], scratch, counts,
        )  # fmt: skip
        if admitted != checks.OK:
            continue
        k = last[m].counter if len(slots) > 1 else 0
        bit, jumped = np.uint64(1) << np.uint64(m), counts[checks.COUNTER_JUMP] > jumps
        _join(slots[k], progress[0], bit, t_us[i], jumped, lifetime_us, counts)
        if m == row_message:
            slots[k].row_us = t_us[i] - row.offset_us
        for j in range(row.n_roles):
            values[k, roles[row.first_role + j].column] = scratch[j]
        if slots[k].mask != full:
            continue
        flags = _complete(slots, slots[k], progress[0], messages[row_message].late_us, counts)
        if flags >= 0:
            out_t_us[n_out], out_flags[n_out] = slots[k].row_us, flags
            for j in range(values.shape[1]):
                out_values[n_out, j] = values[k, j]
            n_out += 1
    return n_out


@kernel
def finish(state: State, counts: NDArray[np.int64]) -> None:
    """Count the open cycles and close them; state and counts (reasons,) changed in place."""
    _close_older(state.slots, np.iinfo(np.int64).max, counts)
