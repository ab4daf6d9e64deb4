"""A delay and the lag of the spools: what the record tells is their sum, and a part of a sample."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.diagnose import exact, lag_interval
from rtid.diagnose.commands import Timings
from rtid.diagnose.moving import LAG_REACH
from rtid.diagnose.revision import Revision
from rtid.diagnose.spread import _of_delays
from rtid.effects.laws.pump import PUMP
from rtid.effects.laws.timing import COMMAND_LAWS, delayed
from rtid.estimator.state import Weights
from rtid.model import Lag

STEP_S = 1e-3
DELAY = COMMAND_LAWS["delay"][0]
LAG, PLAY = COMMAND_LAWS["lag"][0], COMMAND_LAWS["play"][0]


def fitted(delay_s: float, lag_s: float, tolerance_s: float = 5e-3, sse: float = 3000.0) -> Any:
    """What is asked of a fit with a delay."""
    now = SimpleNamespace(
        declared=None,
        chunk=None,
        first_given=3,
        estimate=SimpleNamespace(used=()),
        weights=Weights(np.zeros(0), np.zeros(0), lag_s),
        view=SimpleNamespace(step_s=STEP_S),
        lag_tolerance_s=tolerance_s,
        revision=Revision((), ((DELAY, (delay_s,)),), ()),
        timing_columns=lambda k: range(3 + k, 4 + k),
        held=SimpleNamespace(sse=sse),
        regression=SimpleNamespace(dof=3000.0),
        excess=sse - 3000.0,
    )
    now.light = lambda: now
    return now


@pytest.mark.parametrize("part", [0.0, 0.2, 0.5, 0.9])
def test_a_part_of_a_sample_is_as_wide_as_so_much_lag(part: float) -> None:
    """Second moments about the mean of what a step becomes add: that of a lag is its square."""
    u = np.r_[np.zeros(5), np.ones(5)]
    rises = np.diff(delayed(u, STEP_S, ((3.0 + part) * STEP_S,)), prepend=0.0)
    at = STEP_S * np.arange(len(u))
    wide = float(rises @ at**2 - (rises @ at) ** 2)
    assert wide == pytest.approx(part * (1.0 - part) * STEP_S**2, abs=1e-15)
    lag_s = 1.2e-3
    ((column, spread),) = _of_delays(fitted((3.0 + part) * STEP_S, lag_s))
    assert column == 3 and (lag_s + spread) ** 2 == pytest.approx(lag_s**2 + wide, rel=1e-9)


@pytest.mark.parametrize("tolerance_s", [0.0, 1e-5])
def test_no_more_is_shared_than_the_lag_may_be_moved(tolerance_s: float) -> None:
    assert list(_of_delays(fitted(3.5e-3, 1e-3, tolerance_s))) == [(3, LAG_REACH * tolerance_s)]


@pytest.mark.parametrize(
    ("better", "tolerance_s", "at"),
    [
        (60.0, 5e-3, 1.24),  # clearly better at a quarter of the sum
        (20.0, 5e-3, None),  # no more than what parts of samples do
        (60.0, 0.2e-3, None),  # the lag is known better than that
    ],
)
def test_another_share_of_the_sum_is_taken_where_it_is_clearly_better(
    better: float, tolerance_s: float, at: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[tuple[float, float]] = []
    now = fitted(4.85e-3, 0.11e-3, tolerance_s)

    def one_pass(
        _model: Any, _chunk: Any, weights: Any, revision: Revision, *_: Any, **__: Any
    ) -> Any:
        delay_s = revision.timings[0][1][0]
        tried.append((weights.lag_s, delay_s))
        is_near = weights.lag_s < 2e-3
        return fitted(delay_s, weights.lag_s, sse=3000.0 - better * is_near)

    monkeypatch.setattr(lag_interval, "one_pass", one_pass)
    monkeypatch.setattr(exact, "fit", lambda _m, _c, weights, *_, **__: weights.lag_s)
    state: Any = SimpleNamespace(model=SimpleNamespace(lag=Lag(0.0, tolerance_s)), chunk=None)
    ended: Any = exact._split_anew(state, now)
    assert (ended is now) if at is None else (1e3 * ended == pytest.approx(at))
    assert all(lag_s + delay_s == pytest.approx(4.96e-3) for lag_s, delay_s in tried)
    assert len(tried) == (0 if tolerance_s < 1e-3 else 2)


@pytest.mark.parametrize("before", [(), ((LAG, (4e-3,)),)])
def test_what_is_no_delay_and_no_lag_is_let_be(before: Timings) -> None:
    """Whatever stands before it: a pump has three numbers."""
    last = PUMP, (1e8, 1e-3, 1e9)
    state: Any = SimpleNamespace(model=SimpleNamespace(lag=Lag(0.0, 5e-3)), chunk=None)
    now = fitted(4.85e-3, 0.11e-3)
    now.revision = Revision((), (*before, last), ())
    assert exact._split_anew(state, now) is now


def test_a_play_and_the_lag_are_walked_along_their_valley(monkeypatch: pytest.MonkeyPatch) -> None:
    """51 mA and 2.9 ms were told of 41 and 4.9, which left 47 less, and no derivative led there."""
    late, wide, slope = 4.9e-3, 0.41, 100.0  # V per s, as both are late

    def left(lag_s: float, play_v: float) -> float:
        across = (play_v - wide) + slope * (lag_s - late)
        return 3000.0 + 0.3e8 * (lag_s - late) ** 2 + 1e5 * across**2

    def passed(_m: Any, _c: Any, weights: Any, revision: Revision, *_: Any, **__: Any) -> Any:
        play_v = revision.timings[0][1][0]
        now = fitted(0.0, weights.lag_s, sse=left(weights.lag_s, play_v))
        now.revision = revision
        return now

    monkeypatch.setattr(lag_interval, "one_pass", passed)
    monkeypatch.setattr(lag_interval, "_of_lag", lambda *_: slope)
    monkeypatch.setattr(
        exact, "fit", lambda _m, _c, weights, revision, *_, **__: (weights, revision)
    )
    start = passed(None, None, Weights(np.zeros(0), np.zeros(0), 2.9e-3), played_by(0.61))
    state: Any = SimpleNamespace(model=SimpleNamespace(lag=Lag(2e-3, 5e-3)), chunk=None)
    ended: Any = exact._split_anew(state, start)
    weights, revision = ended
    assert weights.lag_s == pytest.approx(late, abs=0.4e-3)
    assert revision.timings[0][1][0] == pytest.approx(wide, abs=0.04)


def played_by(width_v: float) -> Revision:
    return Revision((), ((PLAY, (width_v,)),), ())
