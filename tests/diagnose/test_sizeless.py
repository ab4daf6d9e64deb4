"""What is added beside what was found, and has a size that may be zero, is not told as found."""

from __future__ import annotations

import numpy as np
import pytest

from rtid.diagnose.diagnosis import Result
from rtid.diagnose.fit import one_pass, prepare
from rtid.diagnose.report import NO_SIZE, Diagnosis
from rtid.diagnose.residual import Residual
from rtid.diagnose.revision import Revision
from rtid.diagnose.summary import diagnosis
from rtid.diagnose.trials import AcceptedEffect
from rtid.effects.column import of_page
from rtid.effects.page import effect
from rtid.tell.diagnosed import seen_and_not_named
from tests.diagnose.records import record

LEAK = "internal_leakage_laminar", "a-b"
NOTHING = "external_leakage_laminar", "a"  # whose size is 0.3 of its deviation here


def told(*keys: tuple[str, str]) -> Diagnosis:
    """Of a machine that leaks between its chambers, once these were added, the leak is clear."""
    model, chunk, _ = record("internal_leakage_laminar", 2e-11)
    part, effects = chunk[:6000], tuple(of_page(effect(name), at) for name, at in (LEAK, NOTHING))
    last = one_pass(model, part, prepare(model, part), Revision(effects), None, bank=False)
    rows = np.ones((60, 2))
    left = Residual(np.arange(60.0), rows, rows, rows)
    added = tuple(AcceptedEffect(key, (), 1e3, 1, left, left) for key in keys)
    return diagnosis(Result(last, last, added, {}, [], left, left, "missing"))


def test_it_stands_under_what_was_not_found_with_its_reason() -> None:
    result = told(LEAK, NOTHING)
    assert [(f.effect, f.where) for f in result.found] == [LEAK]
    (own,) = [u for u in result.not_found if u.effect == NOTHING[0]]
    assert (own.where, own.reason, own.visible) == ("a", NO_SIZE, True)
    assert own.detection_limit is not None and own.detection_limit > 0.0
    assert "may as well be zero: External leakage" in " ".join(seen_and_not_named(result))


@pytest.mark.parametrize("keys", [(NOTHING,), (LEAK,), (NOTHING, LEAK)])
def test_what_was_found_first_stays(keys: tuple[tuple[str, str], ...]) -> None:
    """The verdict is of it."""
    assert [(f.effect, f.where) for f in told(*keys).found] == list(keys)
