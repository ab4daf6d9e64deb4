"""See where a map agrees with the measurement and where it does not; arrays in, arrays out."""

from rtid.compare.comparison import Candidate, Comparison, compare, learned, refitted
from rtid.compare.reference import ReferenceMap
from rtid.compare.tables import (
    PAPER_DP_PA,
    PAPER_U_V,
    BlockRow,
    Deviation,
    block_rows,
    deviations,
)

__all__ = [
    "PAPER_DP_PA",
    "PAPER_U_V",
    "BlockRow",
    "Candidate",
    "Comparison",
    "Deviation",
    "ReferenceMap",
    "block_rows",
    "compare",
    "deviations",
    "learned",
    "refitted",
]
