"""What was learned and cannot be: a number whose 95 % interval excludes all that is possible.

It is no result: the model, the geometry or a sensor is wrong.  The moduli of two chambers that
hold the same oil may differ by their hoses and walls; where they do so clearly, that is said.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.estimator.solution import Solution
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.units import Z95, range_of, scale_of

LEAST_LAG_S, MOST_LAG_S = 2e-4, 0.2  # of any spool, as on the catalogue's page
APART, APART_SHARE = 3.0, 0.02  # joint 95 % intervals, and share of their mean, to contradict
STRAIGHT = 0.1  # relative half-width up to which 1/c is straight enough for a ±
CHECK = (
    "check areas, dead volumes and the pressures' units and signs, and what is missing with "
    "`rtid diagnose`"
)


@dataclass(frozen=True)
class Doubt:
    """A number that is no result, or two that contradict each other.

    what: beta_NAME, lag or beta; is_invalid: impossible, not only in contradiction.
    """

    what: str
    is_invalid: bool
    reason: str
    remedy: str

    @property
    def text(self) -> str:
        """In one sentence with its remedy."""
        return f"{'invalid: ' if self.is_invalid else ''}{self.reason}: {self.remedy}."


def doubts_of(solution: Solution, lag_s: float = 0.0, lag_sd_s: float = 0.0) -> tuple[Doubt, ...]:
    """What is impossible in a solution, and in a lag that was estimated (sd > 0)."""
    model = solution.model
    return (
        *doubts(model, solution.compliance, solution.compliance_cov),
        *doubts_of_lag(lag_s, lag_sd_s),
    )


def doubts(model: Machine, compliance: FloatArray, cov: FloatArray) -> tuple[Doubt, ...]:
    """Of the chambers' compliances (chambers,), 1/Pa, with their covariance."""
    low, high = sorted(1.0 / bound for bound in model.beta_bounds_pa)
    half = Z95 * np.sqrt(np.maximum(np.diag(cov), 0.0))
    result = []
    for chamber, c, h in zip(model.chambers, compliance, half, strict=True):
        if not chamber.pressure:
            continue
        if c + h < low or c - h > high:
            bounds = range_of(min(model.beta_bounds_pa), max(model.beta_bounds_pa), "Pa")
            result.append(
                Doubt(
                    f"beta_{chamber.name}",
                    True,
                    f"the bulk modulus of chamber {chamber.name}, {_modulus(c, h)}, lies outside "
                    f"the declared {bounds} with its whole interval",
                    CHECK,
                )
            )
    return tuple(result) or _contradiction(model, compliance, cov)


def _contradiction(model: Machine, compliance: FloatArray, cov: FloatArray) -> tuple[Doubt, ...]:
    if len(compliance) != 2:
        return ()
    apart = abs(float(compliance[0] - compliance[1]))
    joint = Z95 * float(np.sqrt(max(0.0, cov[0, 0] + cov[1, 1] - 2.0 * cov[0, 1])))
    if apart <= max(APART * joint, APART_SHARE * abs(float(np.mean(compliance)))):
        return ()
    half = Z95 * np.sqrt(np.maximum(np.diag(cov), 0.0))
    first, two = (
        f"{chamber.name} {_modulus(c, h)}"
        for chamber, c, h in zip(model.chambers, compliance, half, strict=True)
    )
    times = f" by {apart / joint:.0f} joint intervals" if joint > 0.0 else ""
    return (
        Doubt(
            "beta",
            False,
            f"the bulk moduli contradict each other{times}: {first}, {two}",
            "one oil has one modulus: a wrong area ratio does that, or a wall or hose that gives "
            "way at one chamber",
        ),
    )


def _modulus(compliance: float, half: float) -> str:
    """The modulus with its 95 % interval, which is that of the compliance turned over."""
    scale, beta = scale_of("Pa"), 1.0 / compliance if compliance else np.inf
    if half < STRAIGHT * abs(compliance):
        return f"{scale.known(beta, half * beta**2 / Z95, 1)} {scale.name}"
    softest, stiffest = compliance + half, compliance - half
    if softest <= 0.0:
        return f"{scale.number(beta, 1)} {scale.name}, which is negative for certain"
    least = scale.number(1.0 / softest, 1)
    if stiffest <= 0.0:
        return f"{least} {scale.name} or more (95 %)"
    return f"{least} to {scale.number(1.0 / stiffest, 1)} {scale.name} (95 %)"


def doubts_of_lag(lag_s: float, sd_s: float) -> tuple[Doubt, ...]:
    """Of the spools' lag, where it was estimated (sd > 0): none is as quick, or as slow."""
    low, high = lag_s - Z95 * sd_s, lag_s + Z95 * sd_s
    is_zero = low <= 0.0
    if sd_s <= 0.0 or is_zero or (high >= LEAST_LAG_S and low <= MOST_LAG_S):
        return ()
    return (
        Doubt(
            "lag",
            True,
            f"a spool lag of {1e3 * lag_s:.3g} ± {1e3 * Z95 * sd_s:.2g} ms is none of a valve, "
            f"which takes {1e3 * LEAST_LAG_S:g} to {1e3 * MOST_LAG_S:g} ms",
            "check the time stamps of the command against those of the pressures, and declare "
            "dynamics.spool_lag",
        ),
    )
