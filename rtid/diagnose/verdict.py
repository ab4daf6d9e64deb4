"""What a search amounts to: the model matches, something is missing, or nobody can tell."""

from __future__ import annotations

import numpy as np

from rtid.diagnose.fit import Fit
from rtid.diagnose.residual import Residual
from rtid.diagnose.trials import MATCH_RHO, State

MATERIAL = 0.003  # of the rms flow: what an effect must change of the held-out residual
NAMED = 0.8  # of the misfit that effects must explain to be named where something else remains
LEAST_ROWS = 50  # filtered rows that a part must have to be judged by
LEAST_EVIDENCE = 1000  # scalar rows of the record

MATCHES, MISSING, AMBIGUOUS = "matches", "missing", "ambiguous"
UNKNOWN, INSUFFICIENT = "unknown", "insufficient_data"


def can_judge(held: Residual) -> bool:
    """True where the map is known over enough of a part to hold the model against it."""
    return len(held.t_s) >= LEAST_ROWS


def verdict(state: State, first: Fit, last: Fit, after: Residual, is_unseen: bool = True) -> str:
    """The verdict on a search from the first to the last fit, and what that leaves of a part.

    is_unseen: the part is not the one that taught the maps, which may have taken an effect in.
    """
    has_moved = last.regression.rows >= LEAST_EVIDENCE and len(last.map.cells) > 0
    if not has_moved or not can_judge(after):
        return INSUFFICIENT
    if not state.found:
        # what is left may be no noise, and still be too small to matter
        if last.rho >= MATCH_RHO and remainder(after) >= MATERIAL:
            return UNKNOWN
        # what was seen and is too small there may matter on other motion
        is_absorbed = not is_unseen and state.negligible and first.rho >= MATCH_RHO
        return INSUFFICIENT if is_absorbed else MATCHES
    left = last.held.sse - last.regression.dof
    explained = 1.0 - left / state.excess if state.excess > 0 else 1.0
    if last.rho >= MATCH_RHO and explained < NAMED:
        return UNKNOWN
    return AMBIGUOUS if any(f.alike for f in state.found[:1]) else MISSING


def remainder(held: Residual) -> float:
    """What a residual has beyond the sensors' noise, of the rms flow."""
    left = max(0.0, held.rms_m3s**2 - held.floor_m3s**2)
    return float(np.sqrt(left) / max(held.flow_m3s, 1e-12))
