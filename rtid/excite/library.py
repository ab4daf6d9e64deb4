"""Candidate segments: each begins and ends at rest at home, so that any order makes one motion.

    pass     the speed rises or falls steadily along the stroke, there and back: the command creeps
             through block after block, a few tenths of a second in each
    swing    out and back, a sine of the position
    shut     a move, then shut valves with the pressures that it has left: what leaks shows itself

each at several levels of the supply pressure, or while it goes up and down; passes and swings also
with steps of the command on top where an offset is allowed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rtid.excite.driving import OFFSET, SHUT, STEP_S, SUPPLY, V_REF, X_REF
from rtid.excite.motion_limits import Limits
from rtid.plain import FloatArray

Steps = tuple[tuple[float, float], ...]
REST_S = 0.1  # at both ends of a segment
REACH, RANGE = 0.9, 0.96  # of stroke and supply: the true machine differs
PACES = (0.06, 0.15, 0.3, 0.5)  # of the highest speed
SWINGS = ((0.35, 1.0), (0.35, 0.5), (0.65, 1.0), (0.65, 0.5), (0.9, 1.0))  # ... share of the reach
LONGEST_S = 5.0  # of one segment: short ones make a finer choice
TURN_S = 0.08  # between speeds
ZIGZAGS, BRISK = (0.3, 1.0), 0.8  # shares of the supply's range; of its rate
# Steps of the command: share of the largest offset, hold in s.  What a flow leaves in the position
# grows with the time for which it differs, to the power 1.5: some steps are long.
STEPS: Steps = ((1.0, 0.1), (1.0, 0.05), (0.25, 0.15), (0.25, 0.03))
PASS_STEPS: Steps = ((1.0, 0.1), (0.25, 0.03))  # passes creep by themselves
SHUT_PACES, SHUT_S = (0.4, 0.9), 3.0


@dataclass(frozen=True)
class Segment:
    """A candidate: what it is called, and its reference (n, 5) with the columns of `driving`."""

    name: str
    reference: FloatArray

    @property
    def duration_s(self) -> float:
        """Its length."""
        return len(self.reference) * STEP_S

    def scaled(self, share: float, home: float) -> Segment:
        """The same in the same time, nearer to home and slower."""
        reference = self.reference.copy()
        reference[:, X_REF] = home + share * (reference[:, X_REF] - home)
        reference[:, V_REF] *= share
        return replace(self, reference=reference)


def library(limits: Limits, seed: int = 0) -> tuple[Segment, ...]:
    """Every candidate within the limits of stroke, speed and supply, the same for one seed."""
    rng = np.random.default_rng([seed, 11])
    segments = [*_passes(limits, rng), *_swings(limits, rng)]
    if limits.may_shut:
        segments += _shut(limits)
    return tuple(segments)


def home_m(limits: Limits) -> float:
    """Where every segment begins and ends: the middle of the stroke."""
    return 0.5 * (limits.stroke_m[0] + limits.stroke_m[1])


def _reach_m(limits: Limits) -> float:
    return REACH * 0.5 * (limits.stroke_m[1] - limits.stroke_m[0])


def _supplies(limits: Limits, n: int) -> Iterator[tuple[str, FloatArray]]:
    """Supplies (n,) over a segment: three levels, and up and down all along."""
    low, high = limits.supply_pa
    if not limits.supply_varies:
        yield "", np.full(n, low)
        return
    slack = 0.5 * (1.0 - RANGE) * (high - low)
    low, high = low + slack, high - slack
    for level in (low, 0.5 * (low + high), high):
        yield f" at {1e-6 * level:.3g} MPa", np.full(n, level)
    for share in ZIGZAGS:
        lower = high - share * (high - low)
        half_s = (high - lower) / (BRISK * limits.supply_rate_paps)
        turns = max(1, round(0.5 * n * STEP_S / half_s))
        phase = 2.0 * turns * np.arange(n) / n % 2.0
        yield f", supply up and down {share:g}", high - (high - lower) * (1.0 - np.abs(1.0 - phase))


def _passes(limits: Limits, rng: np.random.Generator) -> Iterator[Segment]:
    """To one end, through the whole stroke with the speed between two neighbours, and back."""
    for slow, fast in pairwise(PACES):
        for rising in (True, False):
            first, last = (slow, fast) if rising else (fast, slow)
            mean = 0.5 * (slow + fast) * limits.speed_mps
            way = min(2 * _reach_m(limits), mean * 0.5 * LONGEST_S)
            run = limits.speed_mps * np.linspace(first, last, round(way / mean / STEP_S))
            half = round(way / limits.speed_mps / STEP_S)  # at half the highest speed
            aside = np.full(half, 0.5 * way / (half * STEP_S))
            turn = np.zeros(round(TURN_S / STEP_S))
            v = _eased(np.concatenate([-aside, turn, run, turn, -run, turn, aside]))
            yield from _at_levels(f"pass {first:g} to {last:g}", v, limits, PASS_STEPS, rng)


def _swings(limits: Limits, rng: np.random.Generator) -> Iterator[Segment]:
    for pace, size in SWINGS:
        speed = pace * limits.speed_mps
        for side in (1.0, -1.0):
            way = side * min(size * _reach_m(limits), speed * LONGEST_S / np.pi)
            duration_s = np.pi * abs(way) / speed
            t = STEP_S * np.arange(round(duration_s / STEP_S))
            v = 0.5 * way * 2 * np.pi / duration_s * np.sin(2 * np.pi * t / duration_s)
            name = f"swing {pace:g} of {size:g} {'out' if side > 0 else 'in'}"
            yield from _at_levels(name, v, limits, STEPS, rng)


def _shut(limits: Limits) -> Iterator[Segment]:
    """Out, back faster or slower, and shut on arrival."""
    for pace in SHUT_PACES:
        speed = pace * limits.speed_mps
        for side in (1.0, -1.0):
            way = side * 0.3 * _reach_m(limits)
            run = np.full(round(abs(way) / speed / STEP_S), np.sign(way) * speed)
            v = _eased(np.concatenate([run, -run]))
            for name, reference in _supplied(f"shut {pace:g} {side:+g}", v, limits):
                rest = np.repeat(reference[-1:], round(SHUT_S / STEP_S), axis=0)
                rest[:, SHUT] = 1.0
                yield Segment(name, np.concatenate([reference, rest, reference[-1:]]))


def _at_levels(
    name: str, v: FloatArray, limits: Limits, steps: Steps, rng: np.random.Generator
) -> Iterator[Segment]:
    """With every kind of steps, as far as an offset is allowed, at every level of the supply."""
    for name_, reference in _supplied(name, v, limits):
        yield Segment(name_, reference)
        for share, hold_s in steps if limits.offset_v > 0.0 else ():
            stepped = _with_steps(reference, limits, share, hold_s, rng)
            step = f"steps of {share * limits.offset_v:.2g} V, {hold_s:g} s"
            yield Segment(f"{name_}, {step}", stepped)


def _supplied(name: str, v: FloatArray, limits: Limits) -> Iterator[tuple[str, FloatArray]]:
    """A reference (n, 5) from speeds (n,), with rest around, at every level of the supply."""
    rest = np.zeros(round(REST_S / STEP_S))
    v = np.concatenate([rest, v, rest])
    x = home_m(limits) + STEP_S * np.concatenate([[0.0], np.cumsum(v[:-1])])
    for way, supply in _supplies(limits, len(v)):
        if STEP_S * limits.supply_rate_paps >= np.abs(np.diff(supply)).max(initial=0.0):
            reference = np.zeros((len(v), 5))
            reference[:, X_REF], reference[:, V_REF], reference[:, SUPPLY] = x, v, supply
            yield name + way, reference


def _eased(v: FloatArray) -> FloatArray:
    """Speeds without jumps: a moving average, whose area is the same."""
    width = round(TURN_S / STEP_S)
    padded = np.concatenate([v, np.zeros(width)])
    return np.convolve(padded, np.ones(width) / width)[: len(padded)]


def _with_steps(
    reference: FloatArray, limits: Limits, share: float, hold_s: float, rng: np.random.Generator
) -> FloatArray:
    """Random steps of the command on top, not at rest and no faster than the rate allows."""
    stepped, rest = reference.copy(), round(REST_S / STEP_S)
    most, at = share * limits.offset_v, rest
    while at < len(stepped) - rest:
        end = at + round(hold_s * rng.uniform(0.6, 1.5) / STEP_S)
        stepped[at:end, OFFSET] = most * rng.choice([-1.0, -0.5, 0.5, 1.0])
        at = end
    stepped[-rest:, OFFSET] = 0.0
    stepped[:, OFFSET] = rate_limited(stepped[:, OFFSET], limits.command_rate_vps * STEP_S)
    return stepped


def rate_limited(values: FloatArray, most: float) -> FloatArray:
    """Values (n,), any SI unit, that follow the given ones by at most so much per sample."""
    limited, now = list[float](), float(values[0])
    for value in values.tolist():
        now += min(max(value - now, -most), most)
        limited.append(now)
    return np.array(limited)
