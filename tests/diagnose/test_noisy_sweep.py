"""A clean sweep whose pressures are noisy: what only spreads the rows is no effect."""

from __future__ import annotations

import pytest

from tests.campaign.laws import Case, judged


@pytest.mark.parametrize("law", ["compensated", "choking"])
def test_a_clean_sweep_with_noisy_pressures_matches(law: str) -> None:
    """A line or a gas, both negligible, stayed in the model, and its moduli contradicted."""
    found = judged(Case(5043, law, "sweep_record"))
    assert found is not None
    assert found.said.verdict == "matches"
