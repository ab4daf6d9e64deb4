"""Sensors that are sent every few rows and written in each: measured only where they are sent.

A logger that writes a row each millisecond repeats what it has of a slower message.  While the
machine moves a value then stands for k rows and jumps on by several of its steps at once, which no
sensor does that is read in each row: a coarse one stands still, too, but goes on by a single step.

    rows: where the sensor is sent that comes most seldom; between, every such sensor is on the line
    to its next value, as it is between two messages, and commands act when they did.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from firmware_bridge.samples import GAP, ROW, Samples
from rtid.estimator.noise import HELD_SHARE, SINGLE_RUNS, resolution_of
from rtid.model import SENSORS, Machine
from rtid.plain import BoolArray, FloatArray, IntArray

REPEATED = "repeated"  # counter of the samples that are rows no longer
BY_STEPS = 3.0  # steps of the sensor that a value jumps by at least, where it tells of repeats
FEWEST = 100  # runs between two such jumps, to learn by them
ALIKE = 0.9  # share of these runs that are of one length, give or take a row
BEYOND = 3.0  # times the usual second difference of what is sent: no noise goes so far
RESTS = 6  # times that one value is sent, from which on a sensor rests
LONGEST = 2.5  # usual intervals that a line spans: behind more nothing is known


def rows_per_value(values: FloatArray) -> float:
    """Rows that a value of a sensor (n,), any unit, stands for on the mean; 1: no repeats."""
    jump = np.diff(values)
    if len(jump) < FEWEST or float(np.mean(jump == 0.0)) < HELD_SHARE:
        return 1.0
    at = np.flatnonzero(jump)
    is_wide = _is_wide(values, jump[at])
    runs = np.diff(at)[is_wide[:-1] & is_wide[1:]]
    if len(runs) < FEWEST or float(np.mean(runs == 1)) > SINGLE_RUNS:
        return 1.0
    near = np.abs(runs - np.bincount(runs).argmax()) <= 1
    return float(runs[near].mean()) if near.mean() >= ALIKE else 1.0


def _is_wide(values: FloatArray, jump: FloatArray) -> BoolArray:
    """Jumps (m,) of a sensor (n,) by several of its steps."""
    return np.asarray(np.abs(jump) > (BY_STEPS - 0.5) * resolution_of(values))


def sent(values: FloatArray, rows: float) -> IntArray:
    """Rows (m,) of a sensor (n,) in which it is sent, each value standing for so many rows.

    Where it comes to the same value again, or rests, it is sent in even steps from the last change
    on.  A value that stands for some of them amid a quick motion was not followed: a message was
    lost.
    """
    jump = np.diff(values)
    first = np.flatnonzero(jump) + 1
    lasts = np.diff(np.append(first, len(values)))
    times = np.maximum(1, np.rint(lasts / rows)).astype(np.int64)
    usual = float(np.median(np.abs(np.diff(values[first], 2)))) if len(first) > 2 else 0.0
    is_far = _is_wide(values, jump[first - 1]) & (np.abs(jump[first - 1]) > BEYOND * usual)
    times[is_far & np.append(is_far[1:], False) & (times < RESTS)] = 1
    nth = np.arange(times.sum()) - np.repeat(np.cumsum(times) - times, times)
    return np.asarray(np.repeat(first, times) + np.rint(nth * np.repeat(lasts / times, times)), int)


def where_sent(model: Machine, samples: Samples) -> tuple[Samples, int]:
    """Samples with rows where repeated sensors are sent, and how many are rows no longer.

    As they are where none is repeated.
    """
    each = _repeated(model, samples)
    if not each:
        return samples, 0
    values, flags = samples.values.copy(), samples.flags & ~np.uint8(ROW)
    for name, at in each.items():
        column = samples.names.index(name)
        values[:, column] = _on_lines(samples.t_us, values[:, column], at)
    rows = _rows(model, each, len(samples))
    flags[rows] = samples.flags[rows]
    lost = int(((samples.flags ^ flags) & ROW != 0).sum())
    return replace(samples, values=values, flags=flags), lost


def _repeated(model: Machine, samples: Samples) -> dict[str, IntArray]:
    """The samples in which each repeated sensor is sent, by name; unknown behind a gap."""
    each = {}
    for signal in model.signals:
        if signal.kind in SENSORS and signal.name in samples.names:
            values = samples.column(signal.name)
            if (rows := rows_per_value(values)) > 1.0:
                at = sent(values, rows)
                each[signal.name] = at[(samples.flags[at] & GAP) == 0]
    return each


def _rows(model: Machine, each: Mapping[str, IntArray], n: int) -> IntArray:
    """Samples, of n, in which that of position and chambers' pressures is sent that comes least.

    All where none of them is repeated: a supply may be sent as it likes.
    """
    of_rows = (model.position, *(chamber.pressure for chamber in model.chambers))
    return min((each[name] for name in of_rows if name in each), key=len, default=np.arange(n))


def _on_lines(t_us: IntArray, values: FloatArray, at: IntArray) -> FloatArray:
    """A sensor (n,) on the lines between the samples `at` (m,), as it is where these are rare."""
    after = np.clip(np.searchsorted(at, np.arange(len(t_us))), 1, len(at) - 1)
    spans = t_us[at[after]] - t_us[at[after - 1]]
    is_near = spans <= LONGEST * np.median(np.diff(t_us[at]))
    return np.where(is_near, np.interp(t_us, t_us[at], values[at]), values)
