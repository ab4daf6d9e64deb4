"""A drift of the valves' gain is told with the time that it is of, that of what has taught it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtid.diagnose.fit import one_pass, prepare
from rtid.diagnose.fitted_sizes import parameters
from rtid.diagnose.report import Diagnosis, FoundEffect, Unseen, Value
from rtid.diagnose.revision import Revision
from rtid.effects.column import of_page
from rtid.effects.page import effect
from rtid.tell.diagnosed import remark, said
from tests.diagnose.records import record

DRIFT = effect("valve_gain_drift")
KEY = DRIFT.name, "all valves"
NAN = float("nan")


@pytest.fixture(scope="module")
def told() -> dict[str, Value]:
    """The parameters of a drift of 6 s of a record, from 4 s on."""
    model, chunk, _ = record()
    part, drift = chunk[4000:10001], of_page(DRIFT, KEY[1])
    fitted = one_pass(model, part, prepare(model, part), Revision((drift,)), None, bank=False)
    return parameters(fitted, KEY)


def test_the_time_stands_beside_the_change(told: dict[str, Value]) -> None:
    assert list(told) == ["relative_change", "over"]
    assert told["over"].value == pytest.approx(6.0, abs=0.01) and told["over"].unit == "s"


def test_its_words_have_the_time(told: dict[str, Value]) -> None:
    own = FoundEffect(*KEY, (), told, 0.0, 50.0, 2e-6, 1e-6)
    none = (1.0, 1.0, 2e-6, 1e-6, 1e-6, 1e-4, (1e9,), 0.0, NAN, False, True, (), (), ())
    words = said(Diagnosis("missing", (), (own,), *none))
    assert "over 6 s." in words and words.count("95 %") == 1
    limit = Unseen(*KEY, 1e-3, "1", True, "", form={"over": replace(told["over"], value=45.0)})
    assert remark(limit) == "over 45 s"
