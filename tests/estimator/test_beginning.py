"""Where spools stood before a record, or in a gap, nobody knows: rows begin once that has faded."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.estimator import state
from rtid.estimator.misfit import residual_of
from rtid.estimator.record import refined, summed
from rtid.estimator.solution import sketch
from rtid.estimator.state import SETTLES
from rtid.kernels.engine import GAP_FLAG, ROW_FLAG
from rtid.model import Machine
from rtid.plain import FloatArray
from tests.diagnose.records import record

LATER_S = 0.02  # within which what a wrong beginning has left is still seen


@pytest.fixture(scope="module")
def steps() -> tuple[Machine, FloatArray, list[int]]:
    """A record, and the samples behind its five largest steps of the command."""
    model, chunk, _ = record()
    u = chunk[:, 2 + model.column(model.edges[0].command)]
    return model, chunk, [int(k) + 1 for k in np.argsort(-np.abs(np.diff(u)))[:5]]


def innovations(model: Machine, chunk: FloatArray, part: FloatArray) -> FloatArray:
    """What the map of a whole record leaves of a part of it (n - 1, chambers), whitened."""
    weights = refined(model, sketch(model, summed(model, chunk)), model.lag.nominal_s)
    estimate = sketch(model, summed(model, chunk, weights))
    return residual_of(model, part, weights, estimate).innovation


def test_a_record_that_begins_behind_a_step_is_not_believed_at_once(
    steps: tuple[Machine, FloatArray, list[int]],
) -> None:
    """A false alarm: rows of the first 16 ms were 12 deviations off, and left rho 1.17 of 32 s."""
    model, chunk, at = steps
    settle_s = SETTLES * (model.lag.nominal_s + 0.5 * model.lag.tolerance_s)
    for k in at:
        part = chunk[k : k + 60]
        left, t_s = innovations(model, chunk, part), part[1:, 0] - part[0, 0]
        assert np.isnan(left[t_s <= settle_s]).all()
        here = (t_s > settle_s + 0.002) & (t_s < LATER_S)
        assert 0.2 < np.mean(left[here] ** 2) < 3.0


def test_it_would_be_seen(
    steps: tuple[Machine, FloatArray, list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same where spools are taken to be where they are sent."""
    model, chunk, at = steps
    monkeypatch.setattr(state, "SETTLES", 0.0)
    worst = [np.nanmean(innovations(model, chunk, chunk[k : k + 20]) ** 2) for k in at]
    assert max(worst) > 10.0


def test_behind_a_gap_as_at_the_beginning(steps: tuple[Machine, FloatArray, list[int]]) -> None:
    model, chunk, at = steps
    part = chunk[at[0] - 40 : at[0] + 60].copy()
    part[40, 1] = GAP_FLAG + ROW_FLAG
    left = innovations(model, chunk, part)
    settle_s = SETTLES * (model.lag.nominal_s + 0.5 * model.lag.tolerance_s)
    t_s = part[1:, 0] - part[40, 0]
    assert np.isfinite(left[(t_s < -0.002) & (t_s > -0.02)]).all()
    assert np.isnan(left[(t_s >= 0.0) & (t_s <= settle_s)]).all()
    assert np.isfinite(left[t_s > settle_s + 0.002]).all()


def test_positions_that_come_rarely_begin_with_spools_that_were_followed(
    steps: tuple[Machine, FloatArray, list[int]],
) -> None:
    """Every 20th sample has one: the first row's flow is that of spools that have settled."""
    model, chunk, at = steps
    part = chunk[at[0] : at[0] + 400].copy()
    part[np.arange(400) % 20 != 0, 1] = 0.0
    left = innovations(model, chunk, part)
    assert np.isnan(left[:20]).all() and np.isfinite(left[39]).all()
    assert np.nanmean(left[20:] ** 2) < 4.0
