"""What speaks against an effect that is added by name is asked of the rows that both fits judge."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.diagnose import extend as module
from rtid.diagnose.extend import UNJUDGED
from rtid.diagnose.residual import Residual
from rtid.diagnose.trials import GAIN

FLOW_M3S, RATE = 1e-3, 50.0
SOME, MANY = 100, 120  # rows


def left(*parts: tuple[int, float], first: int = 0) -> Residual:
    """What a fit leaves: so many rows of so much each, in shares of the flow; first: row of all."""
    size = np.concatenate([np.full(n, FLOW_M3S * share) for n, share in parts])[:, None]
    flow = np.full_like(size, FLOW_M3S)
    return Residual((first + np.arange(len(size))) / RATE, flow, size, 0.0 * size, RATE)


def against(monkeypatch: pytest.MonkeyPatch, before: Residual, after: Residual) -> list[str]:
    monkeypatch.setattr(module, "own_share", lambda *_: 1.0)
    monkeypatch.setattr(module, "taken_in", lambda *_: None)
    fit = SimpleNamespace(
        held=SimpleNamespace(sse=4000.0), regression=SimpleNamespace(dof=4000.0), rho=1.0
    )
    last, now = (SimpleNamespace(held_out=rest, fit=fit, state=None) for rest in (before, after))
    trial: Any = SimpleNamespace(gain=10.0 * GAIN)
    return list(module._against(last, now, trial))  # type: ignore[arg-type]


def test_rows_that_the_model_with_it_alone_judges_are_not_held_against_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It halves what is left where both judge, and knows 20 rows more, in which much is left."""
    assert not against(monkeypatch, left((SOME, 0.1)), left((SOME, 0.05), (MANY - SOME, 0.5)))


def test_rows_that_it_has_lost_do_not_speak_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """It doubles what is left where both judge, and the worst 20 rows are judged no more."""
    (said,) = against(monkeypatch, left((SOME, 0.1), (MANY - SOME, 1.0)), left((SOME, 0.2)))
    assert said.startswith("it does not lower the held-out error")
    assert "10.00 % without it, 20.00 % with it" in said


def test_two_that_judge_other_rows_say_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert against(monkeypatch, left((SOME, 0.1)), left((SOME, 0.05), first=SOME)) == [UNJUDGED]


def test_over_the_same_rows_nothing_has_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not against(monkeypatch, left((SOME, 0.1)), left((SOME, 0.05)))
    assert against(monkeypatch, left((SOME, 0.1)), left((SOME, 0.1)))
