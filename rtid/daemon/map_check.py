"""Does the plant still do what the map says?  Samples against the map of the last handover.

The rows' whitened innovations have mean square 1 while the map holds, but much more in the few
blocks whose six terms miss the flow.  So the surprise of a second is the median over its rows of
the mean square of the block that each was taken in: half of the motion must be foretold badly.
Nothing is refused here: it is an observer beside the estimator.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.daemon.jobs import Handover, HandoverJudgement
from rtid.estimator.estimator import Estimator
from rtid.estimator.solution import Solution
from rtid.model import Upkeep
from rtid.plain import FloatArray

CLIP = 10.0  # standard deviations: no single row counts for more
LEAST_ROWS, LEAST_S = 200, 1.0  # innovations and time per judgement
NEVER = 1 << 40


class Judge:
    """Takes samples behind a handover; `knows` is False while too little of the map is known."""

    def __init__(self, handover: Handover, solution: Solution) -> None:
        observer = handover.estimator.copy()
        observer.history = None
        upkeep = Upkeep(innovation_sd=CLIP, innovation_rows=NEVER)
        observer.model = replace(observer.model, upkeep=upkeep)
        self.knows = observer.hold(solution)
        observer.state.engine[0]["admits_all"] = 1
        self._observer: Estimator = observer
        self._number = handover.number
        self._seen, self._since_s = self._totals(), -np.inf

    def push(self, chunk: FloatArray) -> HandoverJudgement | None:
        """Take samples (n, 2 + signals), SI; a judgement when there are enough."""
        if not self.knows or not len(chunk):
            return None
        self._observer.advance(chunk)
        now, t_s = self._totals(), float(chunk[-1, 0])
        new = now.copy()
        new[:, : self._seen.shape[1]] -= self._seen
        rows = new[1].sum()
        if rows < LEAST_ROWS or t_s - self._since_s < LEAST_S:
            return None
        self._seen, self._since_s = now, t_s
        return HandoverJudgement(self._number, _median(*new), int(rows), t_s)

    def _totals(self) -> FloatArray:
        """Surprise and number of innovations of each block (2, blocks)."""
        blocks = self._observer.state.blocks
        return np.stack([blocks["surprise"], blocks["judged"]])


def _median(surprise: FloatArray, judged: FloatArray) -> float:
    """Median over innovations of the mean square of their block."""
    used = judged > 0
    mean, weight = surprise[used] / judged[used], judged[used]
    order = np.argsort(mean)
    total = np.cumsum(weight[order])
    return float(mean[order][np.searchsorted(total, 0.5 * total[-1])])
