"""A long record is read again rather than kept: what is said of it is the same, to the bit."""

from __future__ import annotations

from inspect import unwrap

import pytest

from rtid.diagnose import fit
from rtid.diagnose.diagnosis import searched
from rtid.diagnose.standing import stand
from rtid.diagnose.summary import diagnosis
from rtid.effects import record_view
from rtid.effects.record_view import RecordView
from tests.diagnose.records import record

DELAY = "input_delay", 0.01  # of which trials are refitted exactly


def test_what_was_let_go_is_read_again() -> None:
    model, chunk, _ = record()
    view = RecordView.without_map(model, chunk)
    before = [view.t_s, view.dt_s, view.x_m, view.pressure(0), view.seen.x]
    view.rest()
    assert view.t_s is before[0], "a short record keeps what it has"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(record_view, "LONG", 1)
        view.rest()
    after = [view.t_s, view.dt_s, view.x_m, view.pressure(0), view.seen.x]
    assert all(a is not b and (a == b).all() for a, b in zip(after, before, strict=True))


@pytest.mark.long
@pytest.mark.slow
def test_a_long_record_is_judged_as_a_short_one(monkeypatch: pytest.MonkeyPatch) -> None:
    model, chunk, held_out = record(*DELAY)
    kept = diagnosis(searched(stand(model, chunk, held_out))).as_json()
    times = list[bool]()
    for module in (record_view, fit):
        monkeypatch.setattr(module, "LONG", 1)
    monkeypatch.setattr(record_view, "give_back", lambda: times.append(True))
    standing = stand(model, chunk, held_out)
    times.clear()
    again = unwrap(searched)(standing)  # what `replays` remembers would be no proof
    assert diagnosis(again).as_json() == kept and times
