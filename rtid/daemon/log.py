"""Log lines "time level name key=value ...", and no flood of them.

The same message, known by its template, is written at most BURST times per INTERVAL_S; what was
held back is counted in the next one that is written.
"""

from __future__ import annotations

import logging
import sys
import time

BURST, INTERVAL_S = 15, 10.0
logger = logging.getLogger("rtid")


class FloodGate(logging.Filter):
    """Lets a message (by its template) through BURST times per INTERVAL_S."""

    def __init__(self) -> None:
        super().__init__()
        self._seen: dict[str, list[float]] = {}  # template: start of the interval, count

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write it; the count of those held back is added to its text."""
        now_s = time.monotonic()
        entry = self._seen.setdefault(str(record.msg), [now_s, 0])
        if now_s - entry[0] >= INTERVAL_S:
            held_back = max(0, int(entry[1]) - BURST)
            if held_back:
                record.msg = f"{record.msg} ({held_back} more of these in {INTERVAL_S:g} s)"
            entry[:] = [now_s, 0]
        entry[1] += 1
        return entry[1] <= BURST


def set_up() -> None:
    """Write to standard error, where journald and people look."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        logging.Formatter("%(asctime)s.%(msecs)03d %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S")
    )
    handler.addFilter(FloodGate())
    logger.handlers[:] = [handler]
    logger.setLevel(logging.INFO)
    logger.propagate = False
