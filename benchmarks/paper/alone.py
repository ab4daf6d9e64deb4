"""Maps from what each block has learned itself: no orifice law fills or bends them."""

from __future__ import annotations

from dataclasses import replace

from rtid.estimator.flowmap import FlowMap
from rtid.estimator.published import publish
from rtid.estimator.solution import Solution
from rtid.model import NONE


def alone(solution: Solution) -> FlowMap:
    """The blocks under windows, as `publish` has them where no pressures say it is an orifice."""
    edges = tuple(replace(edge, source=NONE, sink=NONE) for edge in solution.model.edges)
    return publish(replace(solution, model=replace(solution.model, edges=edges)))
