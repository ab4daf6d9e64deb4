"""A delay that hardly gains anything is no cause, and is fitted where it is asked for."""

from __future__ import annotations

import pytest

from rtid.diagnose import exact
from rtid.diagnose.exact import exact_trials
from rtid.diagnose.standing import stand
from rtid.diagnose.trials import GAIN
from rtid.effects.laws.timing import timings_of
from tests.diagnose.records import record


def test_who_asks_for_a_delay_gets_it_whatever_it_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `rtid add --effect input_delay` where next to nothing is late."""
    standing = stand(*record())
    state, fit = standing.state, standing.fit
    laws = [t for t in timings_of(state.model, state.chunk) if t.effect == "input_delay"]
    weak = 0.5 * GAIN, laws[0], laws[0].bank[0], fit.weights.lag_s
    monkeypatch.setattr(exact, "_from_afar", lambda *_: [weak])
    assert not exact_trials(state, fit, laws)
    (trial,) = exact_trials(state, fit, laws, anywhere=True)
    assert trial.key == ("input_delay", "command")
