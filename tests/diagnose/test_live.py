"""A running estimator answers what is missing, from the samples in its ring buffer."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtid.estimator.estimator import Estimator
from rtid.model import Machine, Upkeep
from rtid.study.study import diagnose_live
from rtid.trace.reading import NoSamplesError
from tests.diagnose.records import record


def running(model: Machine, history_s: float) -> Estimator:
    return Estimator(replace(model, upkeep=Upkeep(every_s=10.0, history_s=history_s)))


@pytest.mark.long
def test_a_leak_is_named_from_the_ring_buffer() -> None:
    model, chunk, _ = record("internal_leakage_laminar", 4e-12)
    estimator = running(model, 60.0)
    for k in range(0, len(chunk), 4096):
        estimator.advance(chunk[k : k + 4096])
    before = estimator.state.memory.copy()
    found = diagnose_live(estimator)
    assert found.found[0].effect == "internal_leakage_laminar"
    assert (estimator.state.memory == before).all()


def test_too_few_samples_are_refused_with_the_remedy() -> None:
    model, chunk, _ = record()
    estimator = running(model, 60.0)
    estimator.advance(chunk[:2000])
    with pytest.raises(NoSamplesError, match="samples are kept"):
        diagnose_live(estimator)
    with pytest.raises(NoSamplesError, match="samples are kept"):
        diagnose_live(running(model, 0.0))
