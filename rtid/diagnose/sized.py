"""Coefficients as sizes, and the laws that are linear about their own size alone."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rtid.effects.column import Candidate
from rtid.effects.law import LENGTH, MODULUS, chambers_by_place, fitted_names

if TYPE_CHECKING:
    from rtid.diagnose.fit import Fit

NEAR = 5e-3  # share of a size that its law may be linear about another one by


def physical(fit_: Fit, candidate: Candidate, value: float) -> float:
    """A coefficient as the effect's parameter.

    Where its equation has the oil's modulus, the fitted one counts, not that of the column; a
    change over the record is one over its whole length.
    """
    by_fit = fitted_names(candidate.law)
    if LENGTH in by_fit:
        value *= float(fit_.view.t_s[-1] - fit_.view.t_s[0])
    if MODULUS in by_fit:
        at = list(chambers_by_place(fit_.model)[candidate.where])
        fitted = float(np.mean(fit_.compliance[at]))  # none: an oil that cannot be compressed
        value *= float(np.mean(fit_.weights.compliance[at])) / fitted if fitted else math.inf
    return value


def physical_sd(fit_: Fit, candidate: Candidate) -> float:
    """Standard deviation of the size of an effect of a fit, as its parameter.

    Where its equation has the oil's modulus, c = c' / m, m being the fitted compliance over that of
    the column: var c = (var c' - 2 c' / m cov(c', m) + (c' / m)^2 var m) / m^2.  What is stored
    trades off with the modulus: of 1 L 0.977 +- 0.004 was told, as if the modulus were known.
    """
    column = fit_.column(candidate)
    scale, sd = abs(physical(fit_, candidate, 1.0)), fit_.sd_of(column)
    if MODULUS not in fitted_names(candidate.law) or column not in fit_.estimate.used:
        return scale * sd
    at = list(chambers_by_place(fit_.model)[candidate.where])
    share = fit_.weights.compliance[at] / fit_.weights.compliance[at].sum()
    m, cov = float(fit_.held.theta[at] @ share), max(1.0, fit_.rho) * fit_.estimate.cov
    size = fit_.size_of(column) / m
    own, beside = cov[np.ix_(at, at)] @ share, cov[at, fit_.estimate.used.index(column)]
    more = size**2 * float(share @ own) - 2.0 * size * float(share @ beside)
    return scale * float(np.sqrt(max(sd**2 + more, 0.0)))


def about_its_size(fit_: Fit, candidate: Candidate, value: float) -> Candidate:
    """An effect of a fit whose law is linear about its size, about the size that a value means.

    What stiffens with pressure is V / beta s p / (1 + s p): with the usual oil's 8e-9 in the place
    of s beneath the line, 1.15e-8 was told of 1.29e-8, and moduli 1 % off at 30 deviations.
    """
    page = candidate.law
    if not page.linear_about:
        return candidate
    low, high = page.size.low, page.size.high
    size = float(np.clip(physical(fit_, candidate, value), low, high))
    was = page.inner_size
    return (
        candidate if abs(size - was) <= NEAR * was else replace(candidate, page=page.at_size(size))
    )


def is_about_sizes(fit_: Fit) -> bool:
    """True where every law of a fit that is linear about a size alone is about the one it has."""
    return all(
        about_its_size(fit_, effect, fit_.held.value(fit_.column(effect))).page is effect.page
        for effect in fit_.revision.effects
        if effect.law.linear_about
    )
