"""Judge a project file against a trace, and a raw capture by itself."""

from rtid.check.judge import Finding, Report, judge
from rtid.check.timing import IdTiming, Timing, bus, timing

__all__ = ["Finding", "IdTiming", "Report", "Timing", "bus", "judge", "timing"]
