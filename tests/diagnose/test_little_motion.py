"""Records with little in them: the diagnosis says so, and alarms nobody."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose.diagnosis import search
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.summary import diagnosis
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.tell.diagnosed import sentences
from tests.diagnose.records import record


def judged(model: Machine, chunk: FloatArray, held_out: FloatArray) -> Diagnosis:
    return diagnosis(search(model, chunk, held_out))


@pytest.mark.parametrize("flags", [1, 3])
def test_a_machine_that_stands_still_tells_nothing(flags: int) -> None:
    """The valves stay shut: no block is visited, and nothing is named; with gaps throughout too."""
    model, chunk, _ = record()
    still = np.repeat(chunk[:1], 12_000, axis=0)
    still[:, 1] = flags
    still[:, 0] = 1e-3 * np.arange(len(still))
    for j, signal in enumerate(model.signals):
        noise = np.random.default_rng(j).standard_normal(len(still))
        still[:, 2 + j] = (
            0.0 if signal.kind == "command" else still[0, 2 + j] + signal.noise * noise
        )
    found = judged(model, still[:9000], still[9000:])
    assert (found.verdict, found.found) == ("insufficient_data", ())


@pytest.mark.parametrize("seconds", [4.0, 8.0, 16.0])
def test_a_short_clean_record_raises_no_alarm(seconds: float) -> None:
    model, chunk, held_out = record()
    found = judged(model, chunk[chunk[:, 0] < seconds], held_out)
    assert found.verdict in ("matches", "insufficient_data")
    assert found.found == ()


@pytest.mark.long
def test_a_leak_that_the_maps_have_taken_in_is_no_match() -> None:
    """15 s with a leak and nothing else to judge by: its error is small, the misfit is not."""
    model, chunk, held_out = record("internal_leakage_laminar", 2e-12)
    found = judged(model, chunk[:15_000], held_out[:500])
    assert not found.held_out_judged
    assert found.verdict != "matches" and found.rho_before > 2.0
    if found.verdict == "insufficient_data":
        assert "misses something" in " ".join(sentences(found))


@pytest.mark.long
def test_a_lag_that_nobody_declared_is_found() -> None:
    """The spools' lag, and with it in a set what this motion does not tell from it."""
    model, chunk, held_out = record()
    bare = replace(model, lag=replace(model.lag, nominal_s=0.0, tolerance_s=0.0))
    found = judged(bare, chunk, held_out)
    (own,) = found.found
    assert own.effect == "spool_lag_first_order"
    declared = model.lag.nominal_s
    assert own.parameters["time_constant"].value == pytest.approx(declared, abs=0.3e-3)
