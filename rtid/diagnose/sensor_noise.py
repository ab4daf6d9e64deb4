"""Simulated noise of a machine's sensors along a record, at the rows at which they have measured.

Between its rows a position is on a line in what a record holds, and so is a pressure that comes
less often than the samples.  White noise at every sample is filtered away where theirs is not: with
a position each 10 ms in samples of 1 ms a healthy machine left 2.7 times a floor made of that, and
1.2 times the one of its rows.
"""

from __future__ import annotations

import numpy as np

from rtid.diagnose.evidence import has_position
from rtid.effects.record_view import RecordView
from rtid.estimator.state import variance
from rtid.plain import FloatArray, IntArray

APART = 1.5  # usual steps between two pressures, from which on not every sample has its own
LITTLE = 1e-6  # of a period, that an instant may lie before a multiple of it


def noise_of(view: RecordView, name: str, rng: np.random.Generator) -> FloatArray:
    """A sample of the declared noise of a position or a pressure (n,), in its SI unit.

    As many numbers are drawn as there are samples, so that those of a signal that every sample
    holds are what they would be without this.
    """
    noise = np.sqrt(variance(view.model, name)) * rng.standard_normal(view.n)
    rows = _position_rows(view) if name == view.model.position else _pressure_rows(view)
    if not 0 < len(rows) < view.n:
        return noise
    return np.interp(view.t_s, view.t_s[rows], noise[rows])


def _position_rows(view: RecordView) -> IntArray:
    return np.flatnonzero(has_position(view.chunk))


def _pressure_rows(view: RecordView) -> IntArray:
    """Samples at which a pressure may have come: the first of each period."""
    period_s = view.model.pressure_period_s
    if not period_s > APART * view.step_s:
        return np.arange(view.n)
    nth = np.floor((view.t_s - view.t_s[0]) / period_s + LITTLE)
    return np.flatnonzero(np.diff(nth, prepend=-1.0) > 0.0)
