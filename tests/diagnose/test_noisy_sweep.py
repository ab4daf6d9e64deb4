"""A clean sweep whose pressures are noisy: what only spreads the rows is no effect."""

from __future__ import annotations

import pytest

from rtid.diagnose.verdict import doubts_about
from tests.campaign.laws import Case, judged


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "law"),
    [
        pytest.param(5043, "compensated", marks=pytest.mark.long),
        (5043, "choking"),
        pytest.param(5051, "jump", marks=pytest.mark.long),
    ],
)
def test_a_clean_sweep_with_noisy_pressures_matches(seed: int, law: str) -> None:
    """A line or a gas, both negligible, stayed in the model, and its moduli contradicted.

    On the last the line was named, as hidden in the maps, with moduli that are impossible.
    """
    found = judged(Case(seed, law, "sweep_record"))
    assert found is not None
    assert found.said.verdict == "matches"


@pytest.mark.campaign
def test_moduli_that_the_blocks_misfit_bends_do_not_contradict() -> None:
    """The noise alone gave them 3 and 6 %, and 1040 and 1275 MPa: an alarm on a clean machine."""
    found = judged(Case(5104, "compensated", "sweep"))
    assert found is not None
    assert doubts_about(found.present)
    assert found.said.verdict == "matches" and not found.said.doubts
