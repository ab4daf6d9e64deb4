"""Many updates: the sums stay definite and equal to one period's."""

from __future__ import annotations

import pytest

from tests.campaign.endurance import endure
from tests.campaign.report import leave


@pytest.mark.parametrize("form", ["integral", "carry"])
def test_a_million_updates(form: str) -> None:
    found = endure(1_000_000, form)
    assert found.definite
    assert found.sums_error < 1e-11
    assert found.error < 1e-5


@pytest.mark.campaign
@pytest.mark.parametrize("form", ["integral", "carry"])
def test_a_hundred_million_updates(form: str) -> None:
    found = endure(100_000_000, form)
    state = "definite" if found.definite else "NOT definite"
    figure = f"{state}; sums {found.sums_error:.1e}, parameters {found.error:.1e}"
    leave(f"1e8 updates against one period, {form} form", figure, "definite, 1e-6", "one plant")
    assert found.definite
    assert found.sums_error < 1e-11
    assert found.error < 1e-6
