"""What pressures count from, as air in the oil tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose.air_zero import wins_from_air
from rtid.diagnose.fit import Fit, fit, prepare
from rtid.diagnose.revision import Revision
from rtid.model import PRESSURE
from rtid.units import AIR_PA
from tests.diagnose.records import record


def read(offset_pa: float, effect: str = "entrained_air", strength: float = 0.09) -> Fit:
    """A machine, of which the sensors show so much more than the absolute pressures."""
    model, chunk, _ = record(effect, strength, 6)
    chunk = chunk.copy()
    at = [2 + model.column(s.name) for s in model.signals if s.kind == PRESSURE]
    chunk[:, at] += offset_pa
    return fit(model, chunk, prepare(model, chunk), Revision(), bank=False)


@pytest.mark.first_of(2)
@pytest.mark.parametrize(("offset_pa", "counts_from_air"), [(-AIR_PA, True), (0.0, False)])
def test_air_tells_what_pressures_count_from(offset_pa: float, counts_from_air: bool) -> None:
    """Chambers never fall below 5 bar, and 1 bar of it is another law of the air by 40 of chi2."""
    won, least = wins_from_air(read(offset_pa))
    assert won > least if counts_from_air else won < -least


def test_without_air_nothing_tells() -> None:
    assert wins_from_air(read(-AIR_PA, "external_leakage_laminar", 3e-13)) == (-np.inf, 0.0)


def test_a_model_that_matches_asks_for_nothing() -> None:
    known = read(-AIR_PA)
    as_good = replace(known, held=replace(known.held, sse=known.regression.dof))
    assert wins_from_air(as_good) == (-np.inf, 0.0)
