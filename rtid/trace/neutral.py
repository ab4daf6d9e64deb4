"""The neutral of a command: where the machine stands, whatever the amplifier calls that number.

A radio servo rests at 7.47 % and a proportional valve's amplifier at half its supply; it moves from
day to day.  Most samples in which nothing moves have one and the same command: that one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from firmware_bridge.samples import Samples
from rtid.plain import BoolArray, FloatArray
from rtid.project import Project

STILL = 0.03  # of the quickest motion: slower is standing still
WINDOW_S = 0.4  # over which a motion is taken: longer than sensors jitter
LITTLE = 0.5  # of its share of the motion: a part that has less is no fair judge
COMMON = 0.2  # share of the still samples that one and the same command must have


def neutral_of(t_s: FloatArray, u: FloatArray, state: FloatArray) -> float:
    """The command at which the state stands; nan if it never does.  t_s, u, state (n,), any units.

    The commonest one; where the command is noisy, the median of all of them.
    """
    still = still_of(t_s, state)
    if not still.any():
        return float("nan")
    values, counts = np.unique(u[still], return_counts=True)
    if counts.max() >= COMMON * still.sum():
        return float(values[counts.argmax()])
    return float(np.median(u[still]))


def still_of(t_s: FloatArray, state: FloatArray) -> BoolArray:
    """Samples (n,) about which the state (n,) hardly moves."""
    speed = np.abs(slope_of(t_s, state))
    top = float(np.quantile(speed, 0.99)) if len(speed) else 0.0
    return np.asarray(speed <= STILL * top)


def slope_of(t_s: FloatArray, state: FloatArray) -> FloatArray:
    """Rate (n,) of the state (n,) over a window about each sample, per second."""
    if len(t_s) < 3:
        return np.zeros(len(t_s))
    half = max(1, round(0.5 * WINDOW_S / max(float(np.median(np.diff(t_s))), 1e-9)))
    k = np.arange(len(t_s))
    a, b = np.maximum(k - half, 0), np.minimum(k + half, len(k) - 1)
    return np.asarray((state[b] - state[a]) / np.maximum(t_s[b] - t_s[a], 1e-9))


def held_out_from(t_s: FloatArray, state: FloatArray, share: float) -> float:
    """When all but the last `share` of the motion is over, s: a clock would hold out a standstill.

    t_s (n,), state (n,) in any unit; n > 2.
    """
    way = np.abs(slope_of(t_s, state))[:-1] * np.diff(t_s)
    moved = np.concatenate([[0.0], np.cumsum(way)])
    at = int(np.searchsorted(moved, (1.0 - share) * moved[-1]))
    return round(float(t_s[min(max(at, 1), len(t_s) - 2)]), 6)


def last_part_from(t_s: FloatArray, state: FloatArray, share: float) -> float:
    """When the last `share` of the time begins, s; of the motion, where that holds little of it.

    t_s (n,), state (n,) in any unit; n > 2.
    """
    split = float(t_s[0] + (1.0 - share) * (t_s[-1] - t_s[0]))
    is_enough = np.ptp(state) == 0.0 or held_out_from(t_s, state, LITTLE * share) > split
    return split if is_enough else held_out_from(t_s, state, share)


def neutrals(project: Project, samples: Samples) -> dict[str, float]:
    """The neutral of every command of `offset = "estimate"`, by signal; 0 where it never stands."""
    sections = project.sections
    unknown = [name for name, s in sections.signals.items() if s.offset is None]
    if not unknown or sections.rate is None or not sections.rate.state or len(samples) == 0:
        return {}
    t_s, state = 1e-6 * samples.t_us.astype(np.float64), samples.column(sections.rate.state)
    found = {name: neutral_of(t_s, samples.column(name), state) for name in unknown}
    return {name: u if np.isfinite(u) else 0.0 for name, u in found.items()}


def about_neutral(project: Project, samples: Samples) -> Samples:
    """The samples with every command of `offset = "estimate"` counted from its neutral."""
    values = samples.values.copy()
    for name, neutral in neutrals(project, samples).items():
        values[:, samples.names.index(name)] -= neutral
    return replace(samples, values=values)
