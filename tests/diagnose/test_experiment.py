"""What a wandering supply would show is foretold from a sweep, and then found by simulation."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.diagnose.experiment import limits
from rtid.diagnose.fit import Fit, fit, prepare
from rtid.diagnose.regression import LIMIT_SD
from rtid.diagnose.revision import Revision
from tests.diagnose.records import record

pytestmark = pytest.mark.hidden_effect
LEAKS = ("internal_leakage_laminar", "external_leakage_laminar", "external_leakage_turbulent")


def fitted(motion: str) -> Fit:
    model, chunk, _ = record(motion=motion)
    return fit(model, chunk, prepare(model, chunk), Revision())


def test_detection_limits_of_leaks_are_foretold() -> None:
    """Within a factor of 1.5 of what a record with such a supply then has."""
    swept, varied = fitted("sweep"), fitted("supply")
    leaks = {c.key for c in swept.columns.candidates if c.effect in LEAKS}
    foretold = {c: after for c, (_, after) in limits(swept, leaks).items()}
    ratios = []
    for candidate, after in foretold.items():
        score = varied.regression.score(varied.estimate.used, varied.column(candidate))
        ratios.append(after / (LIMIT_SD * score.sd))
    assert len(ratios) == 5
    assert np.abs(np.log(ratios)).max() < np.log(1.5)
