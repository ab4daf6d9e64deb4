"""What pressures at an end of their range cut of a record is said, and not judged in silence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose.clean import cuts, saturated
from rtid.diagnose.diagnosis import search
from rtid.diagnose.summary import diagnosis
from rtid.model import Machine
from rtid.plain import FloatArray
from rtid.tell.diagnosed import sentences
from tests.diagnose.records import record

LOW_PA = 0.0  # where the sensor's range ends


def cavitating(share: float) -> tuple[Machine, FloatArray, FloatArray]:
    """A record whose p_b stands at the lower end of its range in two spans."""
    model, chunk, held_out = record()
    signals = (replace(s, minimum=LOW_PA) if s.name == "p_b" else s for s in model.signals)
    model = replace(model, signals=tuple(signals))
    chunk, column = chunk.copy(), 2 + model.column("p_b")
    n = len(chunk)
    for start in (int(0.1 * n), int(0.55 * n)):
        chunk[start : start + int(0.5 * share * n), column] = LOW_PA
    return model, chunk, held_out


def test_the_spans_are_those_that_are_cut() -> None:
    model, chunk, _ = cavitating(0.2)
    (own,) = cuts(model, chunk)
    assert (own.signal, own.is_low) == ("p_b", True)
    assert own.share == pytest.approx(float(np.mean(saturated(model, chunk))))
    (begin, end), _ = own.spans_s
    t_s = chunk[:, 0] - chunk[0, 0]
    assert begin == pytest.approx(0.1 * t_s[-1], abs=0.01)
    assert end - begin == pytest.approx(0.1 * t_s[-1], abs=0.01)
    clean = record()[1]
    assert cuts(model, clean) == ()


def test_they_are_said_with_what_they_may_mean() -> None:
    said = diagnosis(search(*cavitating(0.2)))
    text = " ".join(sentences(said))
    assert "20 % of the record was not judged: p_b stood at" in text and "cavitates" in text
    assert said.as_json()["cut"][0]["signal"] == "p_b"


def test_what_is_left_of_a_record_must_be_half_of_it() -> None:
    assert diagnosis(search(*cavitating(0.6))).verdict == "insufficient_data"
