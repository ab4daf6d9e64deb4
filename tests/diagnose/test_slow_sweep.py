"""What the paper's slow sweep tells of an effect, and what its limits are that it states."""

from __future__ import annotations

from functools import cache

import pytest

from tests.campaign.diagnoses import RIGHT
from tests.campaign.laws import Answer, Case, answer

SWEEP = "sweep_record"


@cache
def of(law: str, effect: str) -> Answer:
    found = answer(Case(6101, law, SWEEP, effect))
    assert found is not None
    return found


def test_a_worn_place_is_as_wide_as_it_is() -> None:
    """Held at 30 mm, it left rho 36 where 6.5 are left now, and a leak was named beside it."""
    assert of("orifice", "position_dependent_leakage").judgement == RIGHT


@pytest.mark.parametrize(
    ("law", "effect"),
    [
        ("compensated", "external_leakage_laminar"),
        ("overlap", "input_delay"),
        pytest.param("choking", "valve_seat_leakage", marks=pytest.mark.campaign),
    ],
)
def test_what_is_not_named_is_below_the_limit_that_is_stated(law: str, effect: str) -> None:
    """The leak was kept beside the maps, at 35 times its size, and had no limit; the delay's was
    0.1 ms beside a lag that was kept."""
    missed = of(law, effect)
    assert missed.verdict == "matches"
    assert missed.of_limit < 1.0
