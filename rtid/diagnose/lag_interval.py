"""How well a record tells the spools' lag: by what other lags leave, not by a derivative at one.

Where a joystick's steps take the command from block to block, a lag of half a millisecond more has
other rows in each, and their maps follow: the derivative knew one to 0.2 ms, of which everything
from 2 to 6 ms left the same.  On either side the lag is moved on, twice as far each time, until
chi2 has risen by that of RISE standard deviations, or its range ends:

    sd = (l_+ - l_-) / (2 RISE),        excess(l_+-) - excess(l) = RISE^2 rho.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.diagnose.fit import Fit, one_pass
from rtid.diagnose.moving import LAG_REACH

RISE = 3.0  # standard deviations at which chi2 is looked at
ABOUT = 0.5  # of that rise, with which what the derivative says is not asked again


def lag_sd_s(present: Fit) -> float:
    """Standard deviation of the spools' lag, s; NaN where the record does not tell it."""
    local_s = present.lag_sd_s
    if not np.isfinite(local_s):
        return local_s
    ends = [_end_s(present, way * RISE * local_s) for way in (-1.0, 1.0)]
    return max(local_s, (ends[1] - ends[0]) / (2.0 * RISE))


def _end_s(present: Fit, step_s: float) -> float:
    """The lag at which chi2 has risen, s, by steps that double, or the end of its range."""
    now_s, lag, least = present.weights.lag_s, present.declared.lag, RISE**2 * max(1.0, present.rho)
    most_s = max(now_s, lag.nominal_s + LAG_REACH * lag.tolerance_s)
    low_s, low = now_s, 0.0
    while True:
        at_s = float(np.clip(now_s + step_s, 0.0, most_s))
        weights = replace(present.weights, lag_s=at_s)
        record = present.declared, present.chunk, weights, present.revision
        risen = one_pass(*record, present, False, thorough=False).excess - present.excess
        if low_s == now_s and risen >= ABOUT * least:
            return at_s  # as the derivative says
        if risen >= least:
            return low_s + (at_s - low_s) * (least - low) / (risen - low)
        if at_s != now_s + step_s:
            return at_s
        low_s, low, step_s = at_s, risen, 2.0 * step_s
