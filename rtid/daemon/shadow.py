"""The shadow of a baseline that knows nothing of where the machine works now.

Such a baseline can neither be proven nor contradicted.  What is learned meanwhile takes its place
once it has itself foretold unseen motion, within the level of the baseline, and the samples move as
declared in sign, energy and bounds.
"""

from __future__ import annotations

import math

from rtid.compare import CandidateMap
from rtid.daemon.first import against_first, follows_command
from rtid.daemon.guard import Guard
from rtid.daemon.jobs import Handover
from rtid.estimator.solution import Solution
from rtid.plain import FloatArray


class Shadow:
    """One handover of what was learned without proof, held against the samples behind it."""

    def __init__(
        self, job: Handover, solution: Solution, candidate: CandidateMap, level: FloatArray | None
    ) -> None:
        self.job, self.candidate, self._solution = job, candidate, solution
        self._newest_s = float(job.estimator.state.engine[0]["t_s"])
        # a share that no machine reaches: it is proven by what it has foretold alone
        self.guard = Guard(solution.model, candidate, level, "proving", math.inf)

    def push(self, chunk: FloatArray) -> bool:
        """Take samples (n, 2 + signals), SI, that it has not learned; whether it stands now."""
        chunk = chunk[chunk[:, 0] > self._newest_s]  # it may have overtaken some
        if not self.guard.push(chunk) or self.guard.state != "proven":
            return False
        model, newest = self._solution.model, self.guard.newest
        return follows_command(model, newest) and not against_first(model, newest, self._solution)

    @property
    def is_of_use(self) -> bool:
        """Whether it may still stand, so that no later one need be tried instead."""
        return self.guard.state == "proving" and not self.guard.has_seen_much
