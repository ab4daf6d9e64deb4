"""See where a model agrees with the measurement and where it does not; arrays in, arrays out."""

from rtid.compare.candidate import CandidateMap, learned
from rtid.compare.comparison import Comparison, Intervals, compare, refitted
from rtid.compare.correlation import Correlation, correlations
from rtid.compare.cusum import Cusum, cusums, recursive_residuals
from rtid.compare.dependence import (
    Dependence,
    across_piston,
    against_signals,
    by_direction,
    over_time,
)
from rtid.compare.examination import Examination, examine
from rtid.compare.motion import smooth_position
from rtid.compare.places import NoSuchBlockError, Visit, blocks_in_span, spans_of_block
from rtid.compare.reference import LearnedReference, Reference, ReferenceMap
from rtid.compare.sampled import SampleErrors, sample_errors
from rtid.compare.simulation import FREE_RUN, HORIZONS_S, NoFreeRunError, Simulation, simulate
from rtid.compare.tables import (
    PAPER_DP_PA,
    PAPER_U_V,
    BlockRow,
    Deviation,
    block_rows,
    deviations,
)
from rtid.effects.extra import ExtraFlowError, with_extra_flow

__all__ = [
    "FREE_RUN",
    "HORIZONS_S",
    "PAPER_DP_PA",
    "PAPER_U_V",
    "BlockRow",
    "CandidateMap",
    "Comparison",
    "Correlation",
    "Cusum",
    "Dependence",
    "Deviation",
    "Examination",
    "ExtraFlowError",
    "Intervals",
    "LearnedReference",
    "NoFreeRunError",
    "NoSuchBlockError",
    "Reference",
    "ReferenceMap",
    "SampleErrors",
    "Simulation",
    "Visit",
    "across_piston",
    "against_signals",
    "block_rows",
    "blocks_in_span",
    "by_direction",
    "compare",
    "correlations",
    "cusums",
    "deviations",
    "examine",
    "learned",
    "over_time",
    "recursive_residuals",
    "refitted",
    "sample_errors",
    "simulate",
    "smooth_position",
    "spans_of_block",
    "with_extra_flow",
]
