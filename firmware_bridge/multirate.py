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
from firmware_bridge.jit import Integer, Record, Records, inlined, kernel
from firmware_bridge.samples import GAP, ROW

NEVER = np.iinfo(np.int64).min

QUEUE = np.dtype([("head", np.int64), ("count", np.int64), ("left", np.int64)])
PENDING = np.dtype(
    [("t_us", np.int64), ("row_flags", np.uint8), ("full", np.bool_), ("broken", np.bool_),
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
    queue: Record,
    times: NDArray[np.int64],
    values: NDArray[np.float64],
    m: Integer,
    t_us: Integer,
    n_roles: Integer,
    scratch: NDArray[np.float64],
) -> bool:
    """Put the scratch values of message m into its queue; True if it was full: the oldest goes."""
    capacity = times.shape[1]
    full = queue.count == capacity
    if full:
        queue.head = (queue.head + 1) % capacity
        queue.count -= 1
        queue.left = 0
    k = (queue.head + queue.count) % capacity
    times[m, k] = t_us
    for j in range(n_roles):
        values[m, k, j] = scratch[j]
    queue.count += 1
    return full


@inlined
def _next_instant(queues: Records, times: NDArray[np.int64]) -> Integer:
    """Earliest sample that every message has reached; NEVER while one has not."""
    earliest = np.iinfo(np.int64).max
    for m in range(len(queues)):
        if queues[m].count <= queues[m].left:
            return NEVER
        k = (queues[m].head + queues[m].left) % times.shape[1]
        earliest = min(earliest, times[m, k])
    return earliest


@inlined
def _advance(queue: Record, times: NDArray[np.int64], m: Integer, t_us: Integer) -> bool:
    """Make message m's sample at this instant, if there is one, its left neighbour."""
    k = (queue.head + queue.left) % times.shape[1]
    if times[m, k] != t_us:
        return False
    queue.head = k
    queue.count -= queue.left
    queue.left = 1
    return True


@inlined
def _evaluate(
    row: Record,
    roles: Records,
    queue: Record,
    times: NDArray[np.int64],
    values: NDArray[np.float64],
    m: Integer,
    t_us: Integer,
    new_row: NDArray[np.float64],
) -> Integer:
    """Values of message m at this instant into new_row; OK, UNPAIRED or SILENT."""
    if queue.left == 0:
        return checks.UNPAIRED
    a, b = queue.head, (queue.head + 1) % times.shape[1]
    share = 0.0
    if times[m, a] != t_us:
        span_us = times[m, b] - times[m, a]
        if span_us > row.limit_us:
            return checks.SILENT
        share = (t_us - times[m, a]) / span_us
    for j in range(row.n_roles):
        role, v = roles[row.first_role + j], values[m, a, j]
        if role.hold != checks.ZERO and share > 0.0:
            v += (values[m, b, j] - v) * share
        new_row[role.column] = v
    return checks.OK


@inlined
def _average(roles: Records, row: NDArray[np.float64], new_row: NDArray[np.float64]) -> None:
    """Replace the monitored commands in row by their mean over the interval to new_row."""
    for r in range(len(roles)):
        if roles[r].hold == checks.MEAN:
            column = roles[r].column
            row[column] = 0.5 * (row[column] + new_row[column])


@inlined
def _emit(
    pending: Record,
    row: NDArray[np.float64],
    out_t_us: NDArray[np.int64],
    out_values: NDArray[np.float64],
    out_flags: NDArray[np.uint8],
    n_out: Integer,
) -> Integer:
    """Write the pending sample, if there is one, to out_*[n_out]; the new number of samples."""
    if not pending.full:
        return n_out
    out_t_us[n_out], out_flags[n_out] = pending.t_us, pending.row_flags
    for j in range(len(row)):
        out_values[n_out, j] = row[j]
    pending.full = False
    return n_out + 1


@inlined
def _renew(pending: Record, t_us: Integer, flags: Integer, counts: NDArray[np.int64]) -> None:
    """Make the instant t_us the pending sample."""
    if pending.broken:
        flags |= GAP
        counts[checks.GAPS] += 1 if pending.started else 0
    pending.t_us, pending.row_flags, pending.full = t_us, flags, True
    pending.broken, pending.started = False, True


@inlined
def _drain(
    plan: checks.Plan,
    state: State,
    row_message: Integer,
    counts: NDArray[np.int64],
    out_t_us: NDArray[np.int64],
    out_values: NDArray[np.float64],
    out_flags: NDArray[np.uint8],
    n_out: Integer,
) -> Integer:
    """Take all instants that every message has passed; the new number of samples in out_*."""
    messages, roles = plan.messages, plan.roles
    _, queues, times, values, pending, row, new_row, _ = state
    instant_us = _next_instant(queues, times)
    while instant_us != NEVER:
        flags, reason = 0, checks.OK
        for m in range(len(messages)):
            if _advance(queues[m], times, m, instant_us) and m == row_message:
                flags |= ROW
            verdict = _evaluate(
                messages[m], roles, queues[m], times, values, m, instant_us, new_row
            )
            if verdict != checks.OK and reason != checks.UNPAIRED:
                reason = verdict
        if reason != checks.OK:
            counts[reason] += 1
            pending[0].broken = True
        elif not pending[0].broken:
            _average(roles, row, new_row)
        n_out = _emit(pending[0], row, out_t_us, out_values, out_flags, n_out)
        if reason == checks.OK:
            _renew(pending[0], instant_us, flags, counts)
            for j in range(len(row)):
                row[j] = new_row[j]
        instant_us = _next_instant(queues, times)
    return n_out


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
    messages, roles, layouts, codes, tables = plan
    last, queues, times, values, pending, _, _, scratch = state
    n_out = 0
    for i in range(len(t_us)):
        m = checks.find_message(messages, can_id[i], channel[i])
        if m < 0:
            counts[checks.UNKNOWN_ID] += 1
            continue
        row = messages[m]
        admitted = checks.admit(
            row, last[m], roles, layouts, codes, tables,
            t_us[i], length[i], words[i], scratch, counts,
        )  # fmt: skip
        if admitted != checks.OK:
            continue
        stamp_us = t_us[i] - row.offset_us
        if _append(queues[m], times, values, m, stamp_us, row.n_roles, scratch):
            counts[checks.SILENT] += 1
            pending[0].broken = True
        n_out = _drain(plan, state, row_message, counts, out_t_us, out_values, out_flags, n_out)
    return n_out


@kernel
def flush(
    state: State,
    out_t_us: NDArray[np.int64],
    out_values: NDArray[np.float64],
    out_flags: NDArray[np.uint8],
) -> Integer:
    """Write the sample that still waits, if there is one; the number of samples in out_*.

    out_t_us, out_flags (samples,) and out_values (samples, columns), SI, changed in place.
    """
    return _emit(state.pending[0], state.row, out_t_us, out_values, out_flags, 0)


@kernel
def count_unpaired(state: State, counts: NDArray[np.int64]) -> None:
    """Count and drop the samples that will never have a right neighbour; changed in place.

    counts (reasons,).
    """
    for m in range(len(state.queues)):
        queue = state.queues[m]
        counts[checks.UNPAIRED] += queue.count - queue.left
        queue.count, queue.left = 0, 0
