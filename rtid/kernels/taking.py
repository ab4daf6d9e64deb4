"""One sample of a whole record at a time, for the passes that hold a model against it."""

from __future__ import annotations

from typing import Any

from rtid.kernels.engine import (
    GAP_FLAG,
    SHUT,
    acceptable,
    commanded,
    remember,
    set_step,
    step_s,
    working_points,
)
from rtid.kernels.jit import inlined
from rtid.kernels.rows import start_whitener
from rtid.plain import FloatArray


@inlined
def take(e: Any, chunk: FloatArray, k: int) -> tuple[bool, bool, float]:
    """Sample k of chunk (n, 2 + signals) to e.sample: (usable, joins the last one, step in s)."""
    for j in range(2 + e.n_signals):
        e.sample[j] = chunk[k, j]
    sample, flags, dt = e.sample, int(e.sample[1]), step_s(e, e.sample[0])
    whole = acceptable(e, sample)
    joined = whole and e.running and 0.0 < dt <= e.max_gap_s and (flags & GAP_FLAG) == 0
    if joined:
        if dt != e.dt_s:
            set_step(e, dt)
        joined = working_points(e, sample, dt)[0]
    return whole, joined, dt


@inlined
def begin(e: Any, sample: FloatArray) -> None:
    """Start at one measured position, sample (2 + signals,) in SI, spools at rest."""
    remember(e, sample)
    e.running = 1
    for i in range(e.n_edges):
        e.w_v[i] = commanded(e, i)
        e.cell[i, 0] = SHUT
    start_whitener(e)
