"""Judge a project file against a trace, and a raw capture by itself."""

from rtid.trace.arrivals import IdTiming, Stamps, Timing, bus, stamps, timing
from rtid.trace.check import Finding, Report, judge, with_learned

__all__ = [
    "Finding",
    "IdTiming",
    "Report",
    "Stamps",
    "Timing",
    "bus",
    "judge",
    "stamps",
    "timing",
    "with_learned",
]
