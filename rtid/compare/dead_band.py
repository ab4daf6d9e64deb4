"""Where a map over a signed command passes nothing, and how steep it is on either side.

On each side the broken line g max(0, min(|w|, s) - h) that comes nearest to the map, weighed by
what the map knows: h is the end of the dead band, g the gain beyond, and from s on no more comes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtid.estimator.flowmap import LEARNING, VALID, EdgeMap
from rtid.plain import FloatArray

POINTS, ENDS = 400, 61  # along the map, and values of h and s
MISSED = 0.05  # of the largest flow: what a broken line may miss of a map anyway
NOTHING = float("nan")


@dataclass(frozen=True)
class DeadBand:
    """Commands between which nothing passes, and the gains below and above, flow per command.

    All NaN where the map is not known on both sides of the neutral; low = high = 0 without a band.
    """

    low: float
    high: float
    gain_below: float
    gain_above: float


def dead_band(edge: EdgeMap) -> DeadBand:
    """The band about command 0 of a map over the command alone, in the middle of its other grid."""
    w = np.linspace(edge.grid.u_v[0], edge.grid.u_v[-1], POINTS)
    dp = np.full(len(w), 0.5 * (edge.grid.dp_pa[0] + edge.grid.dp_pa[-1]))
    known = np.isin(edge.status_at(w, dp), (VALID, LEARNING))
    flow, sd = edge.flow(w, dp), edge.sd(w, dp)
    known &= np.isfinite(flow) & np.isfinite(sd)
    below, above = known & (w < 0), known & (w > 0)
    if not (below.any() and above.any()):
        return DeadBand(NOTHING, NOTHING, NOTHING, NOTHING)
    weight = 1.0 / (sd**2 + (MISSED * float(np.abs(flow[known]).max())) ** 2 + 1e-300)
    low, gain_below = _broken_line(-w[below], -flow[below], weight[below])
    high, gain_above = _broken_line(w[above], flow[above], weight[above])
    return DeadBand(-low, high, gain_below, gain_above)


def per_direction(edge: EdgeMap) -> DeadBand:
    """Of a map that is straight on either side of zero: no band, a gain for each side."""
    ends = edge.grid.u_v[[0, -1]]
    flow = edge.flow(ends, np.zeros(2))
    below, above = (float(q / u) if u else NOTHING for q, u in zip(flow, ends, strict=True))
    return DeadBand(0.0, 0.0, below, above)


def _broken_line(w: FloatArray, flow: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """End of the band and gain beyond of one side; w > 0, flow and weight (m,)."""
    ends = np.linspace(0.0, float(w.max()), ENDS)
    best = np.inf, 0.0, 0.0
    for k, full in enumerate(ends[1:], 1):
        beyond = np.maximum(0.0, np.minimum(w, full) - ends[:k, None])
        gain = (beyond * flow) @ weight / (beyond**2 @ weight)
        misfit = (flow - gain[:, None] * beyond) ** 2 @ weight
        j = int(misfit.argmin())
        best = min(best, (float(misfit[j]), float(ends[j]), float(gain[j])))
    return best[1:]
