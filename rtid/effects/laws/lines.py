"""The line between valve and chamber."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rtid.effects.column import Cause, fixed, of_page
from rtid.effects.law import Volumes
from rtid.effects.laws.common import slope_to
from rtid.effects.page import Effect
from rtid.effects.record_view import RecordView


def lines(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """Inertance of a line between valve and chamber, seen by a sensor at either end of it."""
    for c, chamber in enumerate(view.model.chambers):
        for end in ("valve", "cylinder"):
            called = f"inertance_sensor_at_{end}"
            yield fixed(
                of_page(effect, chamber.name, called=called),
                _line, view, c, end,
            )  # fmt: skip


def _line(view: RecordView, c: int, end: str) -> Volumes:
    rate = view.smooth(view.chamber_flow(c), 1)
    if end == "cylinder":
        return {c: rate * slope_to(view, c) * view.dt_s}
    bend = np.diff(rate, prepend=rate[:1])
    return {c: view.compliance[c] * view.volume(c)[:-1] * bend}
