"""Nuisance parameters (spool lag, message offsets): minimise chi2 outside the linear fit.

chi2(nu) = misfit of the linear fit with nu held, plus the prior ((nu - nominal) / tolerance)^2.
Newton steps on a quadratic through finite differences; chi2 is in units of the noise, so half its
Hessian is the information, whose inverse is the covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rtid.plain import FloatArray

MAX_STEPS = 5
LONGEST_STEP = 3.0  # probes
MAX_HALVINGS = 3  # of a step that leads uphill


@dataclass(frozen=True)
class Profile:
    """Minimum of chi2: value (n,), sd (n,), and the number of evaluations."""

    value: FloatArray
    sd: FloatArray
    evaluations: int


def profile(
    chi2: Callable[[FloatArray], float],
    nominal: FloatArray,
    tolerance: FloatArray,
    probe: FloatArray,
    least: FloatArray,
    stages: tuple[float, ...] = (1.0,),
) -> Profile:
    """Minimise chi2 + prior from `nominal`; all arguments (n,), SI (lag and offsets: s).

    tolerance: 0 holds a parameter at its nominal value; probe: distance of the finite differences,
    of the order of what chi2 can resolve but above its roughness; least: lower bound; stages:
    multiples of the probe, one search after the other, wide ones first to step over side valleys.
    """
    free = tolerance > 0
    known: dict[bytes, float] = {}

    def cost(part: FloatArray) -> float:
        nu = nominal.copy()
        nu[free] = np.maximum(part, least[free])
        key = nu.tobytes()
        if key not in known:
            prior = ((nu - nominal)[free] / tolerance[free]) ** 2
            known[key] = chi2(nu) + float(np.sum(prior))
        return known[key]

    part = nominal[free]
    for stage in stages:
        part, sd = _minimise(cost, part, stage * probe[free], least[free])
    value, all_sd = nominal.copy(), np.zeros(len(nominal))
    value[free], all_sd[free] = part, sd
    return Profile(value, all_sd, len(known))


def _minimise(
    cost: Callable[[FloatArray], float], start: FloatArray, probe: FloatArray, least: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Newton's minimum and its standard deviation, half the Hessian being the information."""
    value = np.maximum(start, least + probe)
    best = cost(value)
    for _ in range(MAX_STEPS):
        gradient, hessian = _derivatives(cost, value, probe)
        trial = np.maximum(value + _newton(gradient, hessian, probe), least)
        if np.all(np.abs(trial - value) <= probe):  # the parabola need not be extrapolated
            value = trial
            break
        for _ in range(MAX_HALVINGS):
            if cost(trial) < best:
                break
            trial = 0.5 * (trial + value)
        if cost(trial) >= best:
            break
        value, best = np.maximum(trial, least + probe), cost(trial)
    return value, np.sqrt(2 * np.diag(_inverse(hessian, probe)))


def _derivatives(
    cost: Callable[[FloatArray], float], at: FloatArray, h: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gradient (n,) and Hessian (n, n) by central differences; 1 + 2 n + n (n - 1) / 2 values."""
    n, here, steps = len(at), cost(at), np.diag(h)
    above = np.array([cost(at + steps[i]) for i in range(n)])
    below = np.array([cost(at - steps[i]) for i in range(n)])
    hessian = np.diag((above - 2 * here + below) / h**2)
    for i in range(n):
        for j in range(i):
            both = cost(at + steps[i] + steps[j])
            hessian[i, j] = hessian[j, i] = (both - above[i] - above[j] + here) / (h[i] * h[j])
    return (above - below) / (2 * h), hessian


def _inverse(hessian: FloatArray, h: FloatArray) -> FloatArray:
    """Inverse of the Hessian, made definite where roughness of chi2 made it look otherwise."""
    values, vectors = np.linalg.eigh(hessian * np.outer(h, h))
    values = np.maximum(np.abs(values), 1e-6 * np.abs(values).max() + 1e-12)
    return np.asarray((vectors / values) @ vectors.T * np.outer(h, h))


def _newton(gradient: FloatArray, hessian: FloatArray, h: FloatArray) -> FloatArray:
    """Newton step, at most LONGEST_STEP probes."""
    return np.clip(-_inverse(hessian, h) @ gradient, -LONGEST_STEP * h, LONGEST_STEP * h)
