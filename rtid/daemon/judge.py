"""Does the plant still do what the map says?  Samples against the map of the last handover.

The rows' whitened innovations have mean square 1 while the map holds, a little more where six terms
per block miss the flow.  Nothing is refused here: it is an observer beside the estimator.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.daemon.jobs import Handover, Judgement
from rtid.estimator.estimator import Estimator
from rtid.estimator.solution import Solution
from rtid.model import FloatArray, Upkeep

CLIP = 10.0  # standard deviations: no single row counts for more
LEAST_ROWS = 200  # innovations per judgement
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
        self._seen = self._totals()

    def push(self, chunk: FloatArray) -> Judgement | None:
        """Take samples, rows as in `to_chunk`; a judgement when there are enough."""
        if not self.knows or not len(chunk):
            return None
        self._observer.advance(chunk)
        now = self._totals()
        rows = now[1] - self._seen[1]
        if rows < LEAST_ROWS:
            return None
        surprise = float((now[0] - self._seen[0]) / rows)
        self._seen = now
        return Judgement(self._number, surprise, int(rows), float(chunk[-1, 0]))

    def _totals(self) -> FloatArray:
        blocks = self._observer.state.blocks
        return np.array([blocks["surprise"].sum(), blocks["judged"].sum()])
