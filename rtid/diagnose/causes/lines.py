"""The line between valve and chamber."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rtid.diagnose.candidates import (
    Candidate,
    Cause,
    Volumes,
    fixed,
)
from rtid.diagnose.causes.common import slope_to
from rtid.diagnose.view import View


def lines(view: View) -> Iterator[Cause]:
    """Inertance of a line between valve and chamber, seen by a sensor at either end of it."""
    for c, chamber in enumerate(view.model.chambers):
        for end in ("valve", "cylinder"):
            parameter = f"inertance_sensor_at_{end}"
            yield fixed(
                Candidate("line_dynamics", chamber.name, parameter, "Pa s2/m3", 1e11),
                _line, view, c, end,
            )  # fmt: skip


def _line(view: View, c: int, end: str) -> Volumes:
    rate = view.smooth(view.chamber_flow(c), 1)
    if end == "cylinder":
        return {c: rate * slope_to(view, c) * view.dt_s}
    bend = np.diff(rate, prepend=rate[:1])
    return {c: view.compliance[c] * view.volume(c)[:-1] * bend}
