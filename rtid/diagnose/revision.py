"""What was added to a model."""

from __future__ import annotations

from dataclasses import dataclass

from rtid.diagnose.commands import Timings
from rtid.effects.column import Candidate
from rtid.effects.laws.timing import TimingLaw, lagged


@dataclass(frozen=True)
class Revision:
    """What was added to a model: effects with their shapes, timings with their parameters.

    sizes: coefficients of the effects as fitted last, which weigh the rows.
    """

    effects: tuple[Candidate, ...] = ()
    timings: Timings = ()
    sizes: tuple[tuple[Candidate, float], ...] = ()

    @property
    def replaces_lag(self) -> bool:
        """True where a timing stands for the declared lag of the spools."""
        return any(timing.replaces_lag for timing, _ in self.timings)

    @property
    def has_slow_spool(self) -> bool:
        """True where a lag more is in it: spools of one pole that is slower have no other."""
        return any(is_slow_spool(timing) for timing, _ in self.timings)

    @property
    def n_causes(self) -> int:
        """Number of effects and timings."""
        return len(self.effects) + len(self.timings)

    def has(self, key: tuple[str, str]) -> bool:
        """True where a cause is part of it."""
        return key in [e.key for e in self.effects] or any(t.is_at(*key) for t, _ in self.timings)


def is_slow_spool(timing: TimingLaw) -> bool:
    """True for a lag of first order before the opening curve."""
    return timing.apply is lagged and not timing.of_sensor
