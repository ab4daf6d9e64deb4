"""Gauss-Newton over what is not linear: lag, timings, shapes of effects, and what weighs the rows.

A step follows the derivative columns of a fit, shortened as a whole where one parameter would go
too far: parameters that do nearly the same move together.  One that makes the misfit larger is
halved.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from rtid.diagnose.commands import Timings
from rtid.diagnose.regression import Estimate
from rtid.diagnose.revision import Revision
from rtid.diagnose.sized import about_its_size
from rtid.effects.column import Candidate
from rtid.effects.laws import cause_of
from rtid.effects.laws.timing import Psi, TimingLaw
from rtid.estimator.state import Weights
from rtid.plain import FloatArray

if TYPE_CHECKING:
    from rtid.diagnose.fit import Fit

CLEAR = 2.0  # standard deviations of a way that is clear
SETTLED = 0.2  # of a standard deviation: a step as short ends it
REACH = 0.6  # of a timing parameter: the longest step
SHAPE_REACH = 0.5  # the same of an effect's nonlinear parameter, in steps of its axis
SIZED = 0.05  # share by which compliances and sizes of effects may still change: they weigh
FEW_OUT, MOST_OUT = 0.005, 0.05  # of the rows that a step may take off the grids
LEFT_OUT = 10.0  # times the usual that each of them is taken to leave
LAG_REACH = 3.0  # tolerances of the declared lag
FAR = 10.0  # rho above which what is missing would pass for a modulus, or for a lag far off
NOISE = 4.0  # of chi2: two fits are as good as one another
ENOUGH = 1e-3  # the same, of the misfit
LEAST_LAG_S, LEAST_SHARE = 5e-6, 2e-3  # steps of a lag and of a timing that are not worth a pass
STEEPEST = -4.0  # of what a compliance finds over what weighs it: a straight line through two fits
LEAST_SPACING = 1e-3  # the same of a shape, of its axis' spacing


@dataclass(frozen=True)
class Step:
    """What to fit next."""

    revision: Revision
    weights: Weights


def moved(fit: Fit, stretch: float = 1.0) -> Step | None:
    """Where the derivatives point, so many times as far; None where nothing is left to move."""
    old, way = fit.revision, _Way.of(fit, stretch)
    timings = tuple(
        (timing, way.timed(k, timing, psi)) for k, (timing, psi) in enumerate(old.timings)
    )
    effects = tuple(way.reshaped(effect) for effect in old.effects)
    sizes = tuple((e, way.size(o)) for e, o in zip(effects, old.effects, strict=True))
    is_near = fit.regression.rho(fit.estimate) < FAR  # once all that may move has moved
    weights = replace(fit.weights, lag_s=way.lag_s(LAG_REACH if is_near else 1.0))
    if is_near or any(effect.is_whole for effect in old.effects):  # whose column knows the modulus
        weights = replace(weights, compliance=_compliance(fit))
    is_same = (timings, effects) == (old.timings, old.effects) and _weigh_alike(sizes, old.sizes)
    is_same &= weights.lag_s == fit.weights.lag_s
    is_same &= all(e.page is o.page for e, o in zip(effects, old.effects, strict=True))
    is_same &= weights.compliance is fit.weights.compliance
    return None if is_same else Step(Revision(effects, timings, sizes), weights)


def reweighed(fit: Fit) -> Weights | None:
    """Weights with the compliances that a fit has found; None where they weigh the same."""
    compliance = _compliance(fit)
    if compliance is fit.weights.compliance:
        return None
    return replace(fit.weights, compliance=compliance)


def steadied(step: Step | None, fit: Fit, before: Fit) -> Step | None:
    """The step of a fit, its compliances at rest where they would swing back from the fit before.

    A line's column is made with the compliance that weighs the rows, and the larger that is the
    less it leaves to the chamber: both went from bound to bound and back until the passes were
    used up.  Where a straight line through both fits finds what it was made with they are at rest;
    halfway, which is that of a slope of -1, took 21 passes for one of -2.
    """
    if step is None:
        return None
    target, now, was = step.weights.compliance, fit.weights.compliance, before.weights.compliance
    swings = (target - now) * (now - was) < 0.0
    if not swings.any():
        return step
    slope = (target - _possible(before)) / np.where(swings, now - was, 1.0)
    share = np.where(swings, 1.0 / (1.0 - np.clip(slope, STEEPEST, 0.0)), 1.0)
    compliance = now + share * (target - now)
    return replace(step, weights=replace(step.weights, compliance=compliance))


def halfway(best: Fit, step: Step) -> Step:
    """Half the way from a fit to a step that went too far."""
    old, new = best.revision, step.revision
    timings = tuple(
        (timing, _mean(psi, was))
        for (timing, psi), (_, was) in zip(new.timings, old.timings, strict=True)
    )
    effects = tuple(
        replace(e, shape=_mean(e.shape, was.shape))
        for e, was in zip(new.effects, old.effects, strict=True)
    )
    sizes = tuple((e, size) for e, (_, size) in zip(effects, new.sizes, strict=True))
    lag_s = 0.5 * (best.weights.lag_s + step.weights.lag_s)
    return Step(Revision(effects, timings, sizes), replace(step.weights, lag_s=lag_s))


def is_as_good(fit: Fit, best: Fit) -> bool:
    """True where a step changed the misfit by next to nothing."""
    misfit = best.held.sse - best.regression.dof
    return abs(best.excess - fit.excess) < max(NOISE, ENOUGH * misfit)


def goes_on(fit: Fit, best: Fit) -> bool:
    """True where lag and timings clearly point on from a fit, the way that led to it from `best`.

    Steps of a command that leave their blocks bend the maps: the derivative was a fifth of the way
    of a joystick's lag, which stood still on the first level stretch, at 8.6 +- 0.15 ms of 14.
    """
    steps = {fit.first_given: fit.weights.lag_s - best.weights.lag_s}
    pairs = zip(fit.revision.timings, best.revision.timings, strict=True)
    for k, ((_, psi), (_, was)) in enumerate(pairs):
        steps |= zip(fit.timing_columns(k), np.subtract(psi, was).tolist(), strict=True)
    least = CLEAR * float(np.sqrt(max(1.0, fit.rho)))
    estimate = fit.estimate
    clear = [
        step * estimate.value(at)
        for at, step in steps.items()
        if step and at in estimate.used and abs(estimate.value(at)) > least * estimate.sd(at)
    ]
    return bool(clear) and min(clear) > 0.0


def is_worse(fit: Fit, best: Fit) -> bool:
    """True where a step made the misfit larger, both being weighed alike, or lost rows.

    Nor is a law about its size worse than one that was linear about another size, nor a shape that
    leaves more of rows which it weighs for less noise.  What air takes up of a pressure's noise
    goes with its exponent: on the way from 1.36 to the 1.315 that explained most, chi2 rose by 69
    and ln det of the noise fell by 83, so that it stayed at 1.36 +- 0.01.
    """
    left_out = 1.0 - fit.regression.rows / max(1.0, best.regression.rows)
    more = counted_for(left_out, fit.revision.timings)
    if more > 0.0:
        return fit.excess + more * fit.held.sse > best.excess
    alike = np.array_equal(fit.weights.compliance, best.weights.compliance)
    alike = alike and _weigh_alike(fit.revision.sizes, best.revision.sizes)
    pairs = zip(fit.revision.effects, best.revision.effects, strict=True)
    alike = alike and all(effect.page is was.page for effect, was in pairs)
    is_more = fit.excess > best.excess and fit.wins_over(best) < 0.0
    return alike and is_more and not is_as_good(fit, best)


def is_lost(fit: Fit, top: Fit) -> bool:
    """True where a fit has ended far worse than its best pass, weighed otherwise.

    On their way to weights that agree with what they find, fits may leave more; but a line ended
    with 500 times what it had begun with, and was refuted.
    """
    return fit.wins_over(top) < -max(NOISE, top.held.sse)


def counted_for(left_out: float, timings: Timings) -> float:
    """How much more a fit is taken to leave, as a share of it, that leaves out a share of the rows.

    0 for few, inf for most: what is left out cannot misfit.  A spool of second order swings beyond
    its largest command, where there is no map: of one at 113 rad/s and a damping of 0.6 each step
    from 149 and 0.8 towards it was refused.
    """
    if left_out <= FEW_OUT:
        return 0.0
    swings = any(timing.replaces_lag for timing, _ in timings)
    return LEFT_OUT * left_out if swings and left_out < MOST_OUT else float("inf")


def _mean(a: Psi, b: Psi) -> Psi:
    return tuple(0.5 * (x + other) for x, other in zip(a, b, strict=True))


def _weigh_alike(
    a: tuple[tuple[Candidate, float], ...], b: tuple[tuple[Candidate, float], ...]
) -> bool:
    size_a, other = [size for _, size in a], [size for _, size in b]
    return len(size_a) == len(other) and np.allclose(size_a, other, rtol=SIZED, atol=0.0)


def _compliance(fit: Fit) -> FloatArray:
    target, now = _possible(fit), fit.weights.compliance
    return now if np.allclose(target, now, rtol=SIZED, atol=0.0) else target


def _possible(fit: Fit) -> FloatArray:
    """The compliances (chambers,) that a fit has found, 1/Pa, within what is declared."""
    low, high = sorted(1.0 / bound for bound in fit.model.beta_bounds_pa)
    return np.clip(fit.compliance, low, high)


@dataclass(frozen=True)
class _Way:
    """Where a fit's derivatives point, and the share of it that may be gone at once."""

    found: Fit
    estimate: Estimate
    share: float = 1.0

    @classmethod
    def of(cls, fit: Fit, stretch: float = 1.0) -> _Way:
        """A declared lag that would leave its range stays, and the others go without it.

        Beside a slow spool it goes to nothing at first, with all others.
        """
        way = cls(fit, fit.estimate)
        if fit.revision.has_slow_spool and LEAST_LAG_S < fit.weights.lag_s < -way._lag_step_s:
            stretch = min(stretch, fit.weights.lag_s / -way._lag_step_s)
        elif not fit.revision.replaces_lag and way._lag_leaves():
            used = tuple(k for k in fit.estimate.used if k != fit.first_given)
            way = cls(fit, fit.regression.fit(used))
        return replace(way, share=min([stretch, *way._shares()]))

    def lag_s(self, reach: float) -> float:
        """The declared lag to go on with, at most so many tolerances off."""
        now, at, lag = self.found.weights.lag_s, self.found.first_given, self.found.model.lag
        if self.found.lag_tolerance_s == 0.0 or at not in self.estimate.used:
            return now
        low, high = (lag.nominal_s + k * reach * lag.tolerance_s for k in (-1.0, 1.0))
        if self.found.revision.has_slow_spool:
            low = 0.0
        target = now + self.share * self.estimate.value(at)
        # one that is farther off already was let go there when less was missing
        target = float(np.clip(target, min(max(0.0, low), now), max(high, now)))
        return target if self._is_open(at) and abs(target - now) > LEAST_LAG_S else now

    def timed(self, k: int, timing: TimingLaw, psi: Psi) -> Psi:
        """The parameters of timing k to go on with."""
        new = []
        for j, (value, at) in enumerate(zip(psi, self.found.timing_columns(k), strict=True)):
            target = value + self.share * self.estimate.value(at)
            target = float(np.clip(target, timing.low[j], timing.high[j]))
            is_far = abs(target - value) > LEAST_SHARE * abs(value)
            new.append(target if is_far and self._is_open(at) else value)
        return tuple(new)

    def reshaped(self, effect: Candidate) -> Candidate:
        """An effect with its nonlinear parameters moved by what their derivatives took."""
        size, shape = self.estimate.value(self.found.column(effect)), list(effect.shape)
        cause = cause_of(self.found.view, effect)
        for k, at in self.found.shape_columns(effect).items() if size else ():
            step = self.share * self.estimate.value(at) / size
            if self._is_open(at) and abs(step) > LEAST_SPACING * cause.spacing(k):
                shape[k] = float(np.clip(shape[k] + step, *cause.bounds(k)))
        moved_one = replace(effect, shape=tuple(shape))
        return about_its_size(self.found, moved_one, self.size(effect))

    @property
    def _most_lag_s(self) -> float:
        lag = self.found.model.lag
        return lag.nominal_s + LAG_REACH * lag.tolerance_s

    @property
    def _lag_step_s(self) -> float:
        return self.estimate.value(self.found.first_given)

    def _lag_leaves(self) -> bool:
        target = self.found.weights.lag_s + self._lag_step_s
        return not 0.0 <= target <= self._most_lag_s

    def size(self, effect: Candidate) -> float:
        """What the size of an effect comes to on the share of the way that is gone."""
        column = self.found.column(effect)
        now, then = (of.value(column) for of in (self.found.held, self.estimate))
        return now + self.share * (then - now)

    def _is_open(self, column: int) -> bool:
        """True where the whole way of a parameter, not what may be gone of it, is no chance."""
        sd = float(np.sqrt(max(1.0, self.found.rho))) * self.estimate.sd(column)
        return abs(self.estimate.value(column)) > SETTLED * sd

    def _shares(self) -> Iterator[float]:
        """What each parameter admits of the step."""
        for k, (timing, psi) in enumerate(self.found.revision.timings):
            for j, (value, at) in enumerate(zip(psi, self.found.timing_columns(k), strict=True)):
                reach = REACH * max(abs(value), abs(timing.bank[0][j]) * 0.1)
                yield reach / max(abs(self.estimate.value(at)), 1e-300)
        for effect in self.found.revision.effects:
            size = abs(self.estimate.value(self.found.column(effect)))
            cause = cause_of(self.found.view, effect)
            for k, at in self.found.shape_columns(effect).items():
                step = abs(self.estimate.value(at)) / max(size, 1e-300)
                yield SHAPE_REACH * cause.spacing(k) / max(step, 1e-300)
