"""How old the newest sample is: stamps and arrivals have clocks of their own.

The least difference arrival - stamp of the last 10 to 20 s is a sample that came at once.
"""

from __future__ import annotations

WINDOW_US = 10_000_000


class LagMeter:
    """`note` each newest stamp with the time at which it was taken, us on the loop's clock."""

    def __init__(self) -> None:
        self._least: int | None = None
        self._before: int | None = None
        self._since_us = 0
        self._stamp_us = 0

    def note(self, stamp_us: int, now_us: int) -> None:
        """A sample of this stamp was learned now."""
        self._stamp_us = stamp_us
        late_us = now_us - stamp_us
        if self._least is None or late_us < self._least:
            self._least = late_us
        if now_us - self._since_us >= WINDOW_US:
            self._before, self._least, self._since_us = self._least, late_us, now_us

    def age_s(self, now_us: int) -> float | None:
        """Seconds since the newest sample was taken by its sensors; None before the first."""
        known = [least for least in (self._least, self._before) if least is not None]
        return max(0.0, (now_us - self._stamp_us - min(known)) * 1e-6) if known else None
