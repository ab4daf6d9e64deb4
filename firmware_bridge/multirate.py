"""Mode "multirate": messages with their own periods, unsynchronised, brought to common instants.

An instant is every time at which any message was sampled.  At an instant T a signal whose
message has neighbouring samples (t0, v0), (t1, v1) with t0 <= T < t1 is

    v0                                        held command
    v0 + (v1 - v0) (T - t0) / (t1 - t0)       sensor
    mean of the same line over [T, T next]    sampled monitor of a faster command

There is no sample of any message between two instants, so that mean is the mean of both ends.
An instant waits until every message has passed it, and one more instant for the mean.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge import checks
from firmware_bridge.jit import Integer, Records, inlined, kernel
from firmware_bridge.samples import GAP, ROW

QUEUE = np.dtype([("head", np.int64), ("count", np.int64), ("left", np.int64)])
PENDING = np.dtype(
    [("t_us", np.int64), ("flags", np.uint8), ("full", np.bool_), ("broken", np.bool_),
     ("started", np.bool_)]
)  # fmt: skip


class State(NamedTuple):
    """Samples that wait for their neighbours; all arrays are changed in place.

    last: LAST (m,); queues: QUEUE (m,), ring buffers in times int64 (m, capacity) and values
    float64 (m, capacity, roles), whose first entry is the left neighbour if `left` is 1;
    pending: PENDING (1,), the sample that waits for the next instant, in row float64 (columns,);
    new_row: float64 (columns,), the one in the making; scratch: float64 (roles,).
    """

    last: Records
    queues: Records
    times: NDArray[np.int64]
    values: NDArray[np.float64]
    pending: Records
    row: NDArray[np.float64]
    new_row: NDArray[np.float64]
    scratch: NDArray[np.float64]


@inlined
def _append(
    state: State, m: Integer, t_us: Integer, n_roles: Integer, counts: NDArray[np.int64]
) -> None:
    """Put the scratch values of message m into its queue; a full queue loses its oldest."""
    queue, capacity = state.queues[m], state.times.shape[1]
    if queue.count == capacity:
        queue.head = (queue.head + 1) % capacity
        queue.count -= 1
        queue.left = 0
        counts[checks.SILENT] += 1
        state.pending[0].broken = True
    k = (queue.head + queue.count) % capacity
    state.times[m, k] = t_us
    state.values[m, k, :n_roles] = state.scratch[:n_roles]
    queue.count += 1


@inlined
def _next_instant(state: State) -> Integer:
    """Earliest sample that every message has reached; -1 while one has not."""
    earliest = np.iinfo(np.int64).max
    for m in range(len(state.queues)):
        queue = state.queues[m]
        if queue.count <= queue.left:
            return np.iinfo(np.int64).min
        k = (queue.head + queue.left) % state.times.shape[1]
        earliest = min(earliest, state.times[m, k])
    return earliest


@inlined
def _advance(state: State, m: Integer, t_us: Integer) -> bool:
    """Make message m's sample at this instant, if there is one, its left neighbour."""
    queue, capacity = state.queues[m], state.times.shape[1]
    if state.times[m, (queue.head + queue.left) % capacity] != t_us:
        return False
    queue.head = (queue.head + queue.left) % capacity
    queue.count -= queue.left
    queue.left = 1
    return True


@inlined
def _evaluate(plan: checks.Plan, state: State, m: Integer, t_us: Integer) -> Integer:
    """Values of message m at this instant into new_row; OK, UNPAIRED or SILENT."""
    queue, capacity, row = state.queues[m], state.times.shape[1], plan.messages[m]
    if queue.left == 0:
        return checks.UNPAIRED
    a, b = queue.head, (queue.head + 1) % capacity
    share = 0.0
    if state.times[m, a] != t_us:
        span_us = state.times[m, b] - state.times[m, a]
        if span_us > row.limit_us:
            return checks.SILENT
        share = (t_us - state.times[m, a]) / span_us
    for j in range(row.n_roles):
        role, v = plan.roles[row.first_role + j], state.values[m, a, j]
        if role.hold != checks.ZERO and share > 0.0:
            v += (state.values[m, b, j] - v) * share
        state.new_row[role.column] = v
    return checks.OK


@inlined
def _take_instant(plan: checks.Plan, state: State, t_us: Integer, row_message: Integer) -> Integer:
    """Fill new_row for this instant; its flags, or -1 - reason if there is no sample."""
    flags, reason = 0, checks.OK
    for m in range(len(plan.messages)):
        exact = _advance(state, m, t_us)
        if exact and m == row_message:
            flags |= ROW
        verdict = _evaluate(plan, state, m, t_us)
        if verdict != checks.OK and reason != checks.UNPAIRED:
            reason = verdict
    return flags if reason == checks.OK else -1 - reason


@inlined
def _average(plan: checks.Plan, row: NDArray[np.float64], new_row: NDArray[np.float64]) -> None:
    """Replace the monitored commands in row by their mean over the interval to new_row."""
    for r in range(len(plan.roles)):
        if plan.roles[r].hold == checks.MEAN:
            column = plan.roles[r].column
            row[column] = 0.5 * (row[column] + new_row[column])


@inlined
def emit(
    state: State,
    out_t_us: NDArray[np.int64],
    out_values: NDArray[np.float64],
    out_flags: NDArray[np.uint8],
    n_out: Integer,
) -> Integer:
    """Write the pending sample, if there is one, to out_*[n_out]; the new number of samples."""
    pending = state.pending[0]
    if not pending.full:
        return n_out
    out_t_us[n_out], out_flags[n_out] = pending.t_us, pending.flags
    out_values[n_out] = state.row
    pending.full = False
    return n_out + 1


@inlined
def _renew_pending(
    plan: checks.Plan, state: State, t_us: Integer, flags: Integer, counts: NDArray[np.int64]
) -> None:
    """Make new_row the pending sample."""
    pending = state.pending[0]
    if pending.broken:
        flags |= GAP
        counts[checks.GAPS] += 1 if pending.started else 0
    state.row[:] = state.new_row
    pending.t_us, pending.flags, pending.full = t_us, flags, True
    pending.broken, pending.started = False, True


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
    counts: NDArray[np.int64],
    out_t_us: NDArray[np.int64],
    out_values: NDArray[np.float64],
    out_flags: NDArray[np.uint8],
) -> Integer:
    """Run n frames through the assembly; the number of samples written to out_*.

    Changed in place: state, counts (REASONS,), out_* (room for n samples + all queued + 1).
    """
    n_out = 0
    for i in range(len(t_us)):
        m = checks.find_message(plan.messages, can_id[i], channel[i])
        if m < 0:
            counts[checks.UNKNOWN_ID] += 1
            continue
        admitted = checks.admit(
            plan, m, state.last, t_us[i], length[i], words[i], state.scratch, counts
        )
        if admitted != checks.OK:
            continue
        row = plan.messages[m]
        _append(state, m, t_us[i] - row.offset_us, row.n_roles, counts)
        instant_us = _next_instant(state)
        while instant_us != np.iinfo(np.int64).min:
            flags = _take_instant(plan, state, instant_us, row_message)
            if flags < 0:
                counts[-1 - flags] += 1
                state.pending[0].broken = True
            elif not state.pending[0].broken:
                _average(plan, state.row, state.new_row)
            n_out = emit(state, out_t_us, out_values, out_flags, n_out)
            if flags >= 0:
                _renew_pending(plan, state, instant_us, flags, counts)
            instant_us = _next_instant(state)
    return n_out


@kernel
def count_unpaired(state: State, counts: NDArray[np.int64]) -> None:
    """Count and drop the samples that will never have a right neighbour; changed in place."""
    for m in range(len(state.queues)):
        queue = state.queues[m]
        counts[checks.UNPAIRED] += queue.count - queue.left
        queue.count, queue.left = 0, 0
