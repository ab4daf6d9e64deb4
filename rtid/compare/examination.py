"""Everything that one candidate says about one part of a trace, in one object."""

from __future__ import annotations

from dataclasses import dataclass

from rtid.compare.candidate import CandidateMap
from rtid.compare.comparison import Comparison, compare
from rtid.compare.correlation import Correlation, correlations
from rtid.compare.cusum import Cusum, cusums
from rtid.compare.dependence import Dependence, against_signals, by_direction, over_time
from rtid.compare.motion import smooth_position
from rtid.compare.simulation import HORIZONS_S, Simulation, simulate, why_no_free_run
from rtid.model import Machine
from rtid.plain import FloatArray


@dataclass(frozen=True)
class Examination:
    """Both errors of a candidate on one part of a trace, and what they depend on.

    equation: the equation residual; simulations by name: free run and k steps ahead, empty where
    no_free_run says why.  cusums: of this part alone, the blocks' means learned in the part before.
    """

    equation: Comparison
    simulations: dict[str, Simulation]
    no_free_run: str
    signals: list[Dependence]
    direction: Dependence
    time: Dependence
    correlations: list[Correlation]
    cusums: list[Cusum]


def examine(
    model: Machine,
    candidate: CandidateMap,
    chunk: FloatArray,
    seen: bool = False,
    before: Comparison | None = None,
    position_m: FloatArray | None = None,
    extra_flow: FloatArray | None = None,
) -> Examination:
    """Examine a candidate on samples chunk (n, 2 + signals).

    seen: the candidate was fitted to them; before: comparison of the part before this one;
    position_m (n,): the smooth position, made if not given; extra_flow (n - 1, chambers) m3/s is
    added to the modelled flow.
    """
    equation = compare(model, candidate, chunk, extra_flow, seen)
    reason = why_no_free_run(model) or ("" if len(chunk) > 1 else "no samples")
    runs = {}
    if not reason:
        x = smooth_position(model, chunk) if position_m is None else position_m
        runs = {
            name: simulate(model, candidate, chunk, name, position_m=x, extra_flow=extra_flow)
            for name in HORIZONS_S
        }
    return Examination(
        equation,
        runs,
        reason,
        against_signals(model, equation),
        by_direction(model, equation),
        over_time(equation),
        correlations(model, equation),
        cusums(model, equation, before),
    )
