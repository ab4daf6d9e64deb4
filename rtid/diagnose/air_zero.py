"""Whether pressures count from nothing or from the air, as air in the oil tells.

Maps and moduli see differences of pressures alone: what these count from is nothing to them.  What
air takes up goes with the absolute pressure,

    dV/dp = -V phi_0 / (kappa p) * (p_0 / p)**(1 / kappa),

so that 2 bar, read as 1, is another law, whose exponent ends at its bound.  Air of 1 % and 1.3,
behind sensors of gauge pressure in bar, was one of 0.74 % and 1.6 at 1.05 times the noise, and
`unknown` on quieter sensors; with its pressures counted from the air it is 1.005 % and 1.305.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.diagnose.fit import Fit, fit, one_pass
from rtid.diagnose.trials import TIE, best_by_key, scored, with_effect
from rtid.effects.column import Candidate
from rtid.effects.law import BOTH
from rtid.effects.laws import causes
from rtid.effects.page import PRESSURE_ZERO
from rtid.model import PRESSURE
from rtid.plain import FloatArray
from rtid.units import AIR_PA

EXPLAINS = 0.5  # of a misfit, that air must explain, for it to say what pressures count from


def wins_from_air(known: Fit) -> tuple[float, float]:
    """What chi2 falls by with pressures counted from the air, and by how much it must be believed.

    known: a fit with its pressures as they are read.  Either reading has air beside it, fitted to
    its end and weighed for what it has found; -inf where that explains too little to tell.
    """
    if known.rho < known.most_rho:
        return -np.inf, 0.0
    read, counted = (with_air(known, chunk) for chunk in (known.chunk, _counted(known)))
    if read is None or counted is None or counted.excess > (1.0 - EXPLAINS) * known.excess:
        return -np.inf, 0.0
    return read.settled_chi2 - counted.settled_chi2, TIE * max(1.0, counted.rho)


def with_air(known: Fit, chunk: FloatArray) -> Fit | None:
    """A fit with air in both chambers beside all it has; None where that cannot be.

    chunk (n, 2 + signals), SI: its record, or with the pressures counted from elsewhere.
    """
    record, revision = (known.declared, chunk, known.weights), replace(known.revision, sizes=())
    if any(map(_is_air, revision.effects)):
        return fit(*record, revision, bank=False)
    first = one_pass(*record, revision, None, bank=False, thorough=False)
    airs = [cause for cause in causes(first.view) if cause.offered and _is_air(cause.candidate)]
    more = [(cause, shape) for cause in airs for shape in cause.shapes]
    seen = one_pass(*record, revision, first, False, more, thorough=False)
    by_key = best_by_key(seen, scored(seen)).values()
    best = max(by_key, key=lambda pair: pair[1].gain, default=None)
    if best is None:
        return None
    return fit(*record, with_effect(seen, best[0]), seen, bank=False)


def _is_air(candidate: Candidate) -> bool:
    """Whether a column goes with the absolute pressures, in both chambers: one oil has one air."""
    return PRESSURE_ZERO in candidate.law.stands_on and candidate.where == BOTH


def _counted(known: Fit) -> FloatArray:
    """The record of a fit (n, 2 + signals), SI, its pressures counted from the air."""
    chunk, model = known.chunk.copy(), known.declared
    chunk[:, [2 + model.column(s.name) for s in model.signals if s.kind == PRESSURE]] += AIR_PA
    return chunk
