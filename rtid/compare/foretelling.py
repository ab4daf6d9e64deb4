"""Whether a machine still does what a map says: a sequential test with stated errors.

Of every second of motion the mean square of the equation residual of a map is held against

    sigma_c^2 = level_c^2 + (TOLERANCE rated flow)^2,    s = mean_c of r_c^2 / sigma_c^2,

level: what the map leaves on nine of ten seconds of the healthy machine.  What a healthy day
changes is taken out before, bounded: the compliance of each chamber (oil and temperature), one
common gain (density) and where all edges turn laminar (viscosity),

    Q ~ (dp^2 + p^2)^(-1/4) dp,     p from LAMINAR_DP_PA / THICKER to LAMINAR_DP_PA THICKER.

A second counts as one observation per chamber: what a map misses belongs to the place where the
machine is.  So with c chambers

    log likelihood ratio of "four times the variance" = c / 2 (0.75 min(s, CLIP) - log 4),

whose cumulative sum above its last minimum is at most once in 1 / FALSE seconds of motion, on
average, beyond log(1 / FALSE) while s <= 1 holds; and the map has foretold the motion once the
total of enough seconds lies below log(MISSED).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtid.compare.candidate import CandidateMap
from rtid.compare.comparison import Comparison, compare
from rtid.estimator.flowmap import SHUT, VALID
from rtid.estimator.orifice import LAMINAR_DP_PA
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray

TOLERANCE = 0.003  # of the rated flow: a sensor's drift, a valve's repeatability
COMPLIANCE, GAIN = 0.2, 0.02  # twice what 20 K do: 0.5 % and 0.035 % per K
THICKER = 2.0  # the viscosity of 20 K: the transition goes with its square, by 4 in all
COMMON = 2  # nuisances beside those of the chambers: gain, viscosity
LEAST_MOTION = 0.05  # share of the largest rated flow by which a second counts as motion
LEAST_ROWS = 10  # known ones, of a second that is judged
FALSE, MISSED = 1e-6, 1e-3
RATIO = 4.0  # of the variance that is looked for
CLIP = 9.0  # one second alone decides nothing
HEALTHY = 0.9  # share of the healthy seconds that lie within the level
WARM_S = 0.5  # until the filter has forgotten how it began
AROUND = 3  # rows beside one that is not known


@dataclass(frozen=True)
class Residuals:
    """Rows of H_f: t_s (n,), residual and columns (n, chambers[, k]), m3/s.

    columns: what the residual loses with each nuisance at its bound; motion (n, chambers), m3/s;
    known (n,): whether the map is known there.
    """

    t_s: FloatArray
    residual: FloatArray
    columns: FloatArray
    motion: FloatArray
    known: BoolArray

    def __add__(self, later: Residuals) -> Residuals:
        """Both, one behind the other."""
        pairs = zip(vars(self).values(), vars(later).values(), strict=True)
        return Residuals(*(np.concatenate(pair) for pair in pairs))

    def since(self, t_s: float) -> Residuals:
        """The rows from a time on."""
        return self.only(self.t_s >= t_s)

    def only(self, wanted: BoolArray | NDArray[np.intp]) -> Residuals:
        """The rows that are marked (n,), or named by their places."""
        return Residuals(*(part[wanted] for part in vars(self).values()))


def residuals(model: Machine, candidate: CandidateMap, chunk: FloatArray) -> Residuals:
    """Hold a map against samples (n, 2 + signals), SI; the first WARM_S give no rows."""
    base = compare(model, candidate, chunk)
    rest = base.residual_m3s
    columns = [
        rest - compare(model, other, chunk).residual_m3s for other in _of_a_day(model, candidate)
    ]
    begin_s = chunk[0, 0] + WARM_S if len(chunk) else 0.0
    used = np.flatnonzero((base.t_s >= begin_s) & np.isfinite(base.measured_m3s).all(axis=1))
    stacked = np.stack(columns, axis=-1)
    rows = Residuals(base.t_s, rest, stacked, base.measured_m3s, _known(base, candidate))
    return rows.only(used)


def _of_a_day(model: Machine, candidate: CandidateMap) -> list[CandidateMap]:
    """The map with each nuisance at one of its bounds."""
    softer = []
    for k in range(len(model.chambers)):
        compliance = candidate.compliance.copy()
        compliance[k] *= 1 + COMPLIANCE
        softer.append(replace(candidate, compliance=compliance))
    gains = (1 + GAIN, 1 + _of_colder(model)[:, None])
    return [*softer, *(replace(candidate, theta=gain * candidate.theta) for gain in gains)]


def _of_colder(model: Machine) -> FloatArray:
    """What 20 K less change of the flow of each cell (cells,), relative: most at low pressure."""
    changes = []
    for edge in model.maps:
        dp_pa = 0.5 * (edge.grid.dp_pa[1:] + edge.grid.dp_pa[:-1])
        warm, cold = (np.hypot(dp_pa, LAMINAR_DP_PA * f) for f in (1 / THICKER, THICKER))
        change = np.sqrt(warm / cold) - 1 if edge.source and edge.sink else np.zeros(len(dp_pa))
        changes.append(np.broadcast_to(change, edge.grid.shape).ravel())
    return np.concatenate(changes)


def _known(base: Comparison, candidate: CandidateMap) -> BoolArray:
    """Rows that stand on valid cells alone, with their neighbours within the filter."""
    valid = np.isin(candidate.status, (SHUT, VALID))
    shut_or_known = (base.cell < 0) | valid[base.cell]
    good = np.all(shut_or_known, axis=1) & np.isfinite(base.residual_m3s).all(axis=1)
    if not len(good):
        return good
    reach = np.ones(2 * AROUND + 1)
    near = np.convolve(~good, reach)[AROUND : AROUND + len(good)]
    return np.asarray(near < 0.5)


def sigma_m3s(model: Machine, level: FloatArray) -> FloatArray:
    """What a residual may be on a healthy day (chambers,); level: of the map, m3/s."""
    return np.asarray(np.hypot(level, TOLERANCE * rated_m3s(model)))


def rated_m3s(model: Machine) -> float:
    """Largest rated flow."""
    return max(edge.rated_q_m3s for edge in model.edges)


def without_day(rows: Residuals, sigma: FloatArray) -> FloatArray:
    """The residual (n, chambers) in units of sigma (chambers,), without what a day may change."""
    from scipy.optimize import lsq_linear  # noqa: PLC0415 - takes long to import

    scaled = rows.residual / sigma
    if not len(scaled):
        return scaled
    columns = (rows.columns / sigma[:, None]).reshape(-1, rows.columns.shape[-1])
    flat = scaled.reshape(-1)
    weight = np.ones(len(flat))
    for _ in range(3):  # a few rows far off must not drag the others along
        day = lsq_linear(weight[:, None] * columns, weight * flat, (-1.0, 1.0)).x
        off = np.abs(flat - columns @ day)
        weight = np.sqrt(1 / np.maximum(1.0, off / (3.0 * np.median(off) + 1e-12)))
    return np.asarray(scaled - (columns @ day).reshape(scaled.shape))


@dataclass(frozen=True)
class Seconds:
    """Seconds of motion: begin (n,), mean squares (n, chambers) in sigma without the day's part."""

    t_s: FloatArray
    squares: FloatArray

    @property
    def ratio(self) -> FloatArray:
        """Log likelihood ratio of each second (n,), dimensionless, for a changed machine."""
        s = np.minimum(self.squares.mean(axis=1), CLIP)
        return np.asarray(0.5 * self.squares.shape[1] * ((1 - 1 / RATIO) * s - np.log(RATIO)))

    @property
    def cusum(self) -> tuple[float, float]:
        """The cumulative sum above its last minimum, and since when it rises."""
        total, since_s = 0.0, float("nan")
        for t_s, ratio in zip(self.t_s, self.ratio, strict=True):
            since_s = t_s if total <= 0.0 else since_s
            total = max(0.0, total + ratio)
        return total, since_s

    @property
    def contradicts(self) -> bool:
        """Whether the machine is another one, with the stated probability of an error."""
        return self.cusum[0] > np.log(1 / FALSE)

    @property
    def foretold(self) -> bool:
        """Whether the map has foretold these seconds."""
        return bool(self.ratio.sum() < np.log(MISSED))


def moving(model: Machine, rows: Residuals) -> Residuals:
    """The rows of the seconds in which the machine moved."""
    second, at = np.unique(np.floor(rows.t_s), return_inverse=True)
    count = np.bincount(at, minlength=len(second))
    square = np.bincount(at, (rows.motion**2).sum(axis=1), minlength=len(second))
    return rows.only((square > count * (LEAST_MOTION * rated_m3s(model)) ** 2)[at])


def in_motion(model: Machine, rows: Residuals) -> Residuals:
    """The rows that the map is known for, of seconds with motion that have enough of them."""
    rows = moving(model, rows)
    rows = rows.only(rows.known)
    second, at = np.unique(np.floor(rows.t_s), return_inverse=True)
    return rows.only((np.bincount(at, minlength=len(second)) >= LEAST_ROWS)[at])


def seconds(model: Machine, rows: Residuals, level: FloatArray) -> Seconds:
    """Judge rows (of `in_motion`) second by second; level (chambers,), m3/s."""
    squares = without_day(rows, sigma_m3s(model, level)) ** 2
    second, at = np.unique(np.floor(rows.t_s), return_inverse=True)
    total = np.zeros((len(second), squares.shape[1]))
    np.add.at(total, at, squares)
    return Seconds(second, total / np.bincount(at, minlength=len(second))[:, None])


def level_of(judged: Seconds, sigma: FloatArray) -> FloatArray:
    """What a map leaves on nine of ten of these seconds (chambers,), m3/s."""
    return np.asarray(np.sqrt(np.quantile(judged.squares, HEALTHY, axis=0)) * sigma)
