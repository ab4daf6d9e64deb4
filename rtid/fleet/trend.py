"""One quantity of one machine over months: drift with its interval, change point, time to a limit.

drift       Theil and Sen's median slope, its interval from Kendall's statistic
change      the split that lowers the sum of absolute deviations most, if chance does not
limit       when the line reaches it, for the ends of the slope's interval
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import rankdata, theilslopes

from rtid.plain import FloatArray

FEWEST, SIDE = 8, 3  # values of a trend; on either side of a change
CHANCE = 0.01  # that a change is named where there is none
DAY_US = 86_400e6


@dataclass(frozen=True)
class Trend:
    """What became of a quantity; times in days from the first value.

    slope per day with its 95 % interval; change_d: when it changed, NaN for never, then slope and
    level are of what came after; level: the value now; limit_d: (soonest, latest) day on which a
    limit is reached, inf for never.
    """

    name: str
    n: int
    level: float
    slope: float
    slope_low: float
    slope_high: float
    change_d: float
    change_by: float
    limit_d: tuple[float, float]

    @property
    def is_drifting(self) -> bool:
        """True where the interval of the slope leaves zero out."""
        return self.slope_low > 0.0 or self.slope_high < 0.0


def trend(name: str, t_d: FloatArray, values: FloatArray, limit: float = float("nan")) -> Trend:
    """The trend of values (n,) at times (n,) in days; too few of them have infinite intervals.

    values, limit: in any one unit, in which the trend comes as well.
    """
    order = np.argsort(t_d, kind="stable")
    t, y = np.asarray(t_d, float)[order], np.asarray(values, float)[order]
    t, y = t[np.isfinite(y)], y[np.isfinite(y)]
    split = change_point(y)
    by = float(np.median(y[split:]) - np.median(y[:split])) if split else 0.0
    at = float(t[split]) if split else float("nan")
    t, y = t[split:], y[split:]
    if len(y) < FEWEST or t[-1] == t[0]:
        level = float(np.median(y)) if len(y) else float("nan")
        return Trend(name, len(y), level, 0.0, -np.inf, np.inf, at, by, (-np.inf, np.inf))
    slope, intercept, low, high = (float(v) for v in theilslopes(y, t))
    level = intercept + slope * float(t[-1])
    reached = sorted(_days_to(limit - level, s) for s in (low, high))
    soon, late = (float(t[-1]) + day for day in reached)
    return Trend(name, len(y), level, slope, low, high, at, by, (soon, late))


def _days_to(distance: float, slope: float) -> float:
    """Days until a line has gone a distance; inf where it never does."""
    if not np.isfinite(distance) or slope == 0.0 or distance / slope < 0.0:
        return float("inf")
    return distance / slope


def change_point(y: FloatArray) -> int:
    """Index of the first value after a change of level; 0 where chance or a drift explains it.

    y (n,) in any unit.  Pettitt's test (1979) on ranks, then two levels against one straight line
    by the sums of their absolute deviations.
    """
    n = len(y)
    if n < FEWEST:
        return 0
    u = 2.0 * np.cumsum(rankdata(y)) - np.arange(1, n + 1) * (n + 1)
    split = SIDE + int(np.argmax(np.abs(u[SIDE - 1 : n - SIDE])))
    k = float(np.abs(u[split - 1]))
    if 2.0 * np.exp(-6.0 * k * k / (n**3 + n**2)) > CHANCE:
        return 0
    line = y - float(theilslopes(y, np.arange(n))[0]) * np.arange(n)
    stepped = _spread(y[:split]) + _spread(y[split:])
    return split if stepped < _spread(line) else 0


def _spread(y: FloatArray) -> float:
    return float(np.abs(y - np.median(y)).sum())


def series(rows: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    """Machine, quantity, days (n,) and values (n,) of all that can be followed.

    These are moduli in Pa, and sizes of effects in the SI units of their coefficients.
    """
    machines = dict.fromkeys(row["machine"] for row in rows)
    for machine in machines:
        of_machine = [r for r in rows if r["machine"] == machine and not r["error"]]
        days = np.array([(r["start_us"] - of_machine[0]["start_us"]) / DAY_US for r in of_machine])
        for c in range(max((len(r["beta_pa"]) for r in of_machine), default=0)):
            beta = [r["beta_pa"][c] if c < len(r["beta_pa"]) else np.nan for r in of_machine]
            yield machine, f"beta_{c}", days, np.array(beta, float)
        named = dict.fromkeys(
            e for r in of_machine for e in zip(r["effects"], r["places"], strict=True)
        )
        for effect, where in named:
            sizes = np.array([_size(r, effect, where) for r in of_machine])
            yield machine, f"{effect}:{where}", days, sizes


def _size(row: Mapping[str, Any], effect: str, where: str) -> float:
    """Size of an effect in a trace; 0 where it was looked for and not found."""
    for name, place, size in zip(row["effects"], row["places"], row["sizes"], strict=True):
        if (name, place) == (effect, where):
            return float(size)
    return 0.0 if row["verdict"] == "matches" else float("nan")
