"""Where a valve opens is known no better than the noise of its pressure lets a corner be seen."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.diagnose.fit import fit
from rtid.diagnose.fitted_sizes import parameters
from rtid.diagnose.standing import stand
from rtid.diagnose.trials import best_by_key, scored, with_effect
from rtid.estimator.state import variance
from tests.diagnose.records import record

RELIEF, SLOPE = ("relief_valve", "a"), 2.8e-10


@pytest.mark.long
def test_an_opening_pressure_counts_the_noise_of_its_sensor() -> None:
    model, chunk, held_out = record(RELIEF[0], SLOPE)
    present = stand(model, chunk, held_out).fit
    relief = best_by_key(present, scored(present))[RELIEF][0]
    ended = fit(
        present.declared, chunk, present.weights, with_effect(present, relief), present, bank=False
    )
    s_pa = float(np.sqrt(variance(model, model.chambers[0].pressure)))
    opening = parameters(ended, RELIEF)["opening_pressure"]
    assert s_pa > 1e3 and s_pa / np.sqrt(3.0) <= opening.std < 2.0 * s_pa
    assert parameters(ended, RELIEF)["slope"].std < 0.05 * SLOPE
