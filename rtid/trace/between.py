"""How far a command is known between its samples, where the log is slower than the controller.

From sample to sample it is on a line, but for what nobody has written down.  A command that walks
by B (variance, per step) leaves the mean of a step, between two known ends, a variance B / 12; one
that trembles by W leaves the sum of many steps W for each.  Both are in its differences,

    E (d2 u)^2 = 6 W + 2 B,    E (d3 u)^2 = 20 W + 6 B,

of which a line, a ramp and a slow swing have none.  Across what jumps nothing is integrated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.sources.table import jumps
from rtid.plain import FloatArray

FASTEST_S = 1.5e-3  # between two samples of a command: up to it a log is no slower than controllers
FEWEST = 100  # differences that tell of it
GAP_STEPS = 1.5  # of the usual step: no difference is taken across a longer one


def unknown_between(t_s: FloatArray, u: FloatArray) -> tuple[float, float]:
    """Its standard deviation from step to step and the usual step, of a command u (n,), its unit.

    t_s (n,): its stamps, s.  A command at rest is known, and not asked; 0 where too little moves.
    """
    step_s = np.diff(t_s)
    usual_s = float(np.median(step_s)) if len(step_s) else 0.0
    if len(step_s) < FEWEST:
        return 0.0, usual_s
    moves = np.diff(u) != 0.0
    whole = _three((step_s <= GAP_STEPS * usual_s) & ~jumps(u)) == 3
    here = whole & (_three(moves) > 0)
    if here.sum() < FEWEST:
        return 0.0, usual_s
    second, third = np.diff(u, 2)[:-1][here], np.diff(u, 3)[here]
    d2, d3 = float(second @ second) / len(second), float(third @ third) / len(third)
    trembles = max(0.0, 0.5 * d3 - 1.5 * d2)
    walks = max(0.0, 0.5 * d2 - 3.0 * trembles)
    return float(np.sqrt(trembles + walks / 12.0)), usual_s


def _three(values: NDArray[np.bool_]) -> FloatArray:
    """Sums (n - 2,) of three neighbours of values (n,)."""
    return np.convolve(values, np.ones(3), "valid")
