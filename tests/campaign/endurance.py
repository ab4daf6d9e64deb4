"""A periodic record repeated for ever: do the sums stay definite, and equal to one period's?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.estimator.blocks import VALID
from rtid.estimator.factor import factorize
from rtid.estimator.solution import solve
from rtid.estimator.state import build
from rtid.estimator.sums import Normal, normal_equations
from rtid.plain import FloatArray
from tests.estimator.cases import plant_case

PERIODS_PER_CALL = 10
PERIOD_S = 20.0  # long enough for most blocks to be known: what is not, amplifies rounding


@dataclass(frozen=True)
class Endurance:
    """definite: the scaled information of all known parameters; errors: of sums, parameters."""

    samples: int
    definite: bool
    sums_error: float
    error: float


def endure(samples: int, form: str = "integral") -> Endurance:
    """Repeat a closed trajectory, each period after a gap, and compare with one period.

    Every period then gives the same rows, so the information is a whole multiple of one period's:
    what differs is rounding.  theta_beta and valid blocks with cond(Phi'Phi) <= 1e6 count.
    """
    case = plant_case(4, form, duration_s=PERIOD_S)
    case = replace(case, model=replace(case.model, lag=replace(case.model.lag, nominal_s=0.0)))
    period = case.chunk
    once = build(case.model)
    once.advance(period)
    one = normal_equations(once)
    n, span = len(period), period[-1, 0] + 1.0
    many = np.tile(period, (PERIODS_PER_CALL, 1))
    many[:, 0] += np.repeat(np.arange(PERIODS_PER_CALL), n) * span
    state, count = build(case.model), 0
    while count < samples:
        chunk = many.copy()
        chunk[:, 0] += count // n % 1000 * span  # stamps stay of a size whose steps are exact
        state.advance(chunk)
        count += len(many)
    all_ = normal_equations(state)
    share = n / count
    scaled = replace(all_, gram=all_.gram * share, right=all_.right * share)
    expected, found = _theta(one), _theta(scaled)
    known = np.ones(len(expected), bool)
    for b, block in enumerate(solve(case.model, once).blocks):
        known[2 + 6 * b : 8 + 6 * b] = block.status == VALID and block.condition <= 1e6
    size = np.sqrt(np.diag(one.gram))
    relative = np.abs(found - expected)[known].max() / np.abs(expected[known]).max()
    lowest = np.linalg.eigvalsh(
        scaled.gram[known][:, known] / np.outer(size, size)[known][:, known]
    )[0]
    sums = np.abs((scaled.gram - one.gram) / np.outer(size, size)).max()
    return Endurance(count, bool(lowest > 0), float(sums), float(relative))


def _theta(normal: Normal) -> FloatArray:
    return factorize(normal, 2).theta(normal.right)
