"""A size that goes with a pressure, and what the size is over the whole record then.

What tells a flow is seldom all of it: the maps follow the rest.  And a gap widens with pressure: so
the size c goes with a pressure p, c0 + c1 (p - p0) / sd p, where p0 is the mean over all of the
effect's own flow, so that c0 is the size over the whole record, and c1 is unknown by W sd p c,

    c0 -> c0 - V01 / (V11 + (W sd p c)^2) c1,     var c0 -> V00 - V01^2 / (V11 + (W sd p c)^2),

where V is their covariance with a free c1.  p is none, the mean of all pressures, that of the
effect's own chamber, or the one between its own two, each as likely as the record makes it,

    2 ln L = c1^2 / V11 - c1^2 / (V11 + (W sd p c)^2) - ln(1 + (W sd p c)^2 / V11).

Of a leak that was 3 % visible, its slope over its own chamber's pressure, 8.55 +- 0.04, was told
for the 7.46 that it let through.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from rtid.diagnose.bank import add_shapes, add_timing
from rtid.diagnose.commands import commands
from rtid.diagnose.evidence import project
from rtid.diagnose.fit import Fit, columns_of_effects
from rtid.effects.column import Candidate, Columns
from rtid.effects.law import Volumes
from rtid.plain import FloatArray

WIDENS = 0.05e-6  # 1/Pa: share by which a gap may let more through, one standard deviation


@dataclass(frozen=True)
class SizeBias:
    """What a size is more than a fit has it, and the standard deviation of that, in its unit."""

    shift: float = 0.0
    sd: float = 0.0

    def beside(self, other: SizeBias) -> SizeBias:
        """Both biases at once."""
        return SizeBias(self.shift + other.shift, float(np.hypot(self.sd, other.sd)))

    def unknown(self) -> SizeBias:
        """One that only widens a size."""
        return SizeBias(0.0, float(np.hypot(self.sd, self.shift)))


NO_BIAS = SizeBias()


@dataclass(frozen=True)
class Rising:
    """A size that goes with a pressure: what it is over the whole record.

    bias: more than where it does not, beyond what the noise leaves of that; column: of the pressure
    that the record makes likeliest; empty where there is none.
    """

    bias: SizeBias = NO_BIAS
    column: Volumes = field(default_factory=dict)

    @classmethod
    def of(cls, fitted: Fit, given: dict[int, Volumes], flow: Candidate) -> Rising:
        """Of one of the effects that are flows."""
        column = fitted.column(flow)
        grown = [_grown(given[column], by) for by in _levels(fitted, given[column])]
        if not grown:
            return cls()
        sizes = SizesBeside.of(fitted, given, [volumes for volumes, _ in grown])
        (plain, known), size = sizes.beside(column), fitted.held.value(column)
        c0, more, best = sizes.averaged(column, [WIDENS * span * size for _, span in grown])
        return cls(SizeBias(c0 - plain, float(np.sqrt(max(0.0, more - known)))), grown[best][0])


def risings(fitted: Fit, given: dict[int, Volumes], flows: list[Candidate]) -> dict[int, Rising]:
    """How sizes of flows of a fit go with a pressure, by column; given: of `given_volumes`."""
    return {fitted.column(flow): Rising.of(fitted, given, flow) for flow in flows}


@dataclass(frozen=True)
class SizesBeside:
    """What the sizes of more columns are beside those of a fit.

    s: products of y, the fit's columns and those more, the maps and the sensors' noise taken out;
    at: place of each of the fit's columns there; prior, mean: by that place.
    """

    s: FloatArray
    at: dict[int, int]
    prior: FloatArray
    mean: FloatArray
    rho: float

    @classmethod
    def of(cls, fitted: Fit, given: dict[int, Volumes], more: list[Volumes]) -> SizesBeside:
        """Of a fit with its rows, and volumes per interval (n - 1,), m3, of the columns more."""
        rows = fitted.own_rows
        known = [0, *range(1, fitted.first_given), *given]
        condensed = [rows.on_rows(column) for column in (*given.values(), *more)]
        s, free, regression = project(rows, condensed).schur, np.zeros(len(more)), fitted.regression
        s[1 : len(known), 1 : len(known)] -= regression.noise_of(known[1:])
        prior, mean = (np.append(of[known], free) for of in (regression.prior, regression.mean))
        at = {column: place for place, column in enumerate(known)}
        return cls(s, at, prior, mean, max(1.0, fitted.rho))

    def in_place_of(self, column: int, more: Iterable[int]) -> tuple[FloatArray, FloatArray]:
        """Sizes (k,) of k of those more, by number, and their covariance (k, k), in their units."""
        return self._free(column, [len(self.at) + k for k in more])

    def beside(self, column: int) -> tuple[float, float]:
        """Size of one of the fit's columns, and its variance, in its unit."""
        sizes, cov = self._free(column, [self.at[column]])
        return float(sizes[0]), float(cov[0, 0])

    def rising(self, column: int, more: int, sd: float) -> tuple[float, float, float]:
        """Size of one of the fit's columns, its variance, and 2 ln of the likelihood.

        Beside one of those more, by number, whose own is 0 within sd, in their unit.
        """
        (c0, c1), v = self._free(column, [self.at[column], len(self.at) + more])
        known, free = max(v[1, 1], 1e-300), v[1, 1] + sd**2
        likely = c1**2 / known - c1**2 / free - np.log(free / known)
        return c0 - v[0, 1] / free * c1, v[0, 0] - v[0, 1] ** 2 / free, likely

    def averaged(self, column: int, sds: list[float]) -> tuple[float, float, int]:
        """Size and variance over none and all of those more, as likely as each is; the likeliest.

        sds: within which their own are 0, as of `rising`.
        """
        none = *self.beside(column), 0.0
        each = [self.rising(column, k, sd) for k, sd in enumerate(sds)]
        c0, var, likely = np.array([none, *each]).T
        share = np.exp(0.5 * (likely - likely.max()))
        share /= share.sum()
        mean = float(share @ c0)
        return mean, float(share @ (var + (c0 - mean) ** 2)), int(np.argmax(likely[1:]))

    def followed(self, column: int, more: int) -> float:
        """How much of one of the fit's columns takes one of those more, beside the others."""
        places = [place for c, place in self.at.items() if c != 0]
        gram = self.s[np.ix_(places, places)] + np.diag(self.prior[places])
        shares, _ = _solved(gram, self.s[places, len(self.at) + more])
        return float(shares[places.index(self.at[column])])

    def _free(self, column: int, free: list[int]) -> tuple[FloatArray, FloatArray]:
        """Of the places `free`, without a prior, beside the fit's columns without one of them."""
        places = [place for c, place in self.at.items() if c not in (0, column)] + free
        prior, mean = self.prior[places], self.mean[places]
        prior[-len(free) :] = 0.0
        right = self.s[places, 0] + prior * mean
        sizes, cov = _solved(self.s[np.ix_(places, places)] + np.diag(prior), right)
        return sizes[-len(free) :], self.rho * cov[-len(free) :, -len(free) :]


def given_volumes(fitted: Fit) -> dict[int, Volumes]:
    """Volumes per interval of every column of a fit behind those of the compliances."""
    view, revision, given = fitted.view, fitted.revision, list[Volumes]()
    raw = Columns(lambda volumes, _: given.append(volumes))
    add_timing(view, raw, commands(fitted.declared, fitted.chunk), fitted.weights, revision)
    list(add_shapes(view, raw, revision))
    columns = [*range(fitted.first_given, fitted.first), *map(fitted.column, revision.effects)]
    return dict(zip(columns, [*given, *columns_of_effects(fitted)], strict=True))


def _levels(fitted: Fit, volumes: Volumes) -> list[Volumes]:
    """Pressures, Pa, that a flow's size may go with, over its chambers' intervals (n - 1,)."""
    if not fitted.view.has_pressures:
        return []
    pressures = [fitted.view.pressure(c) for c in range(len(fitted.model.chambers))]
    at = [0.5 * (p[1:] + p[:-1]) for p in pressures]
    levels: list[Volumes] = [{c: np.mean(at, axis=0) for c in volumes}, {c: at[c] for c in volumes}]
    if len(volumes) == len(at) == 2:
        levels.append({c: np.abs(at[0] - at[1]) for c in volumes})
    return [by for by in levels if any(np.ptp(level) > 0.0 for level in by.values())]


def _grown(volumes: Volumes, levels: Volumes) -> tuple[Volumes, float]:
    """A column that grows with levels, in their deviations over its square; and those, Pa."""
    off = {c: levels[c] - _mean(volumes, levels) for c in volumes}
    sd = max(np.sqrt(_mean(volumes, {c: by**2 for c, by in off.items()})), 1e-300)
    return {c: series * off[c] / sd for c, series in volumes.items()}, sd


def _mean(volumes: Volumes, of: Volumes) -> float:
    """Mean of series of the chambers (n - 1,), in their unit, over the square of a column."""
    whole = sum(float(series @ series) for series in volumes.values())
    return sum(float(volumes[c] ** 2 @ of[c]) for c in volumes) / max(whole, 1e-300)


def _solved(gram: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solution (n,) and inverse (n, n) of products (n, n), scaled on the way."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    outer = np.outer(scale, scale)
    cov = np.linalg.pinv(gram * outer, hermitian=True) * outer
    return cov @ right, cov
