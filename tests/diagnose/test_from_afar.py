"""Timings beside a lag that has gone ahead: the steps of a bank miss the sum that it stands for."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rtid.diagnose import exact
from rtid.effects.laws.timing import COMMAND_LAWS

DELAY = COMMAND_LAWS["delay"][0]
STRENGTHS = {0.0: 0.0, 2e-3: 100.0, 6e-3: 300.0}  # gains of a bank


@pytest.mark.parametrize("ahead", [0.0, 1000.0])
def test_each_is_closed_in_on_before_it_is_held_against_the_lag(ahead: float) -> None:
    """A position that came 4.2 ms late lost by what 2 and 6 ms miss of 7.0, and had no turn."""
    closed: list[float] = []

    def closed_in(*_: Any) -> tuple[Any, float]:
        closed.append(ahead)
        return (4.2e-3,), 5000.0

    coarse: Any = SimpleNamespace(
        ahead=ahead, bank=lambda *_: STRENGTHS, closed_in=closed_in,
        shared=lambda _, psi, gain: (psi, 2.8e-3, gain),
    )  # fmt: skip
    ((gain, timing, psi, lag_s),) = exact._from_afar(coarse, [DELAY], 0.0, {}, False)
    assert (gain, psi, lag_s, timing) == (5000.0 - ahead, (4.2e-3,), 2.8e-3, DELAY)
    assert closed == [ahead], "once"
