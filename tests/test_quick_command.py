"""Whether quick says what it found with a command held, or with one on the line between samples."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.study.quick_command import is_taken
from rtid.study.quick_machine import LAG_SHARE, lag_of


def said(verdict: str, n: int = 0, rho: float = 1.0) -> Any:
    return SimpleNamespace(verdict=verdict, found=[None] * n, rho_after=rho)


@pytest.mark.parametrize(
    ("line", "first", "is_so"),
    [
        (said("matches"), said("unknown"), True),
        (said("insufficient_data"), said("unknown"), True),
        (said("matches"), said("missing", 1), True),
        (said("unknown"), said("missing", 1), False),  # it says less
        (said("missing", 2, 0.9), said("missing", 1), False),  # it names more
        (said("ambiguous", 1, 0.86), said("missing", 1, 0.84), True),  # neither leaves but noise
        (said("ambiguous", 1, 1.3), said("missing", 1, 1.2), False),
    ],
)
def test_what_is_said_in_place_of_the_first(line: Any, first: Any, is_so: bool) -> None:
    assert is_taken(line, first) is is_so


@pytest.mark.parametrize("lag_s", [1.3e-3, 0.0])
def test_a_line_is_late_by_anything_from_nothing_to_half_a_step(lag_s: float) -> None:
    """Its mean and standard deviation are those of what is drawn."""
    step_s, rng = 20e-3, np.random.default_rng(1)
    machine: Any = SimpleNamespace(lag_s=lag_s, command_step_s=step_s)
    own = lag_s * (1.0 + LAG_SHARE * rng.standard_normal(100_000))
    drawn = 1e3 * (own + rng.uniform(0.0, 0.5 * step_s, len(own)))
    lag_ms, tolerance_ms = lag_of(machine)
    assert lag_ms == pytest.approx(drawn.mean(), rel=0.01)
    assert tolerance_ms == pytest.approx(drawn.std(), rel=0.01)
    machine.command_step_s = 0.0
    assert lag_of(machine) == pytest.approx((1e3 * lag_s, 1e3 * LAG_SHARE * lag_s))
