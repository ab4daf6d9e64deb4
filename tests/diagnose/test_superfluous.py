"""What had stood in for a later cause is dropped, and what is needed beside it stays."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rtid.diagnose import diagnosis
from rtid.diagnose.diagnosis import _superfluous
from rtid.plain import Key

KEY: Key = ("extra_dead_volume", "a")
SSE = 5000.0


def present(loses: float, n_timings: int, is_possible: bool = True) -> Any:
    """A fit of one effect and some times, that leaves so much more without the effect."""
    effect = SimpleNamespace(key=KEY, is_possible=lambda _: is_possible)
    return SimpleNamespace(
        revision=SimpleNamespace(effects=(effect,), timings=(None,) * n_timings),
        estimate=SimpleNamespace(sse=SSE, used=(1, 2, 3), value=lambda _: 1.0),
        regression=SimpleNamespace(fit=lambda _: SimpleNamespace(sse=SSE + loses)),
        column=lambda _: 3,
        shape_columns=lambda _: {},
    )


def state(given: bool = False) -> Any:
    """A search that found the effect by 80,500 of chi2."""
    parts = (SimpleNamespace(key=KEY),) if given else ()
    return SimpleNamespace(found=[SimpleNamespace(key=KEY, gain=80_500.0)], given=parts)


@pytest.mark.parametrize(
    ("loses", "n_timings", "is_dropped"),
    [
        (214.0, 1, True),  # a hundredth of what it took: it had stood in for the time
        (70_000.0, 1, False),  # two causes, both needed
        (1_000.0, 1, False),  # more than what is within the other's form
        (214.0, 0, False),  # alone it stands in for nothing
    ],
)
def test_what_has_lost_all_that_it_explained_had_stood_in(
    loses: float, n_timings: int, is_dropped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnosis, "physical", lambda *_: 1.0)
    dropped = _superfluous(state(), present(loses, n_timings))
    assert (dropped is not None) is is_dropped
    assert _superfluous(state(given=True), present(loses, n_timings)) is None


def test_what_cannot_be_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis, "physical", lambda *_: -1.0)
    assert _superfluous(state(), present(70_000.0, 1, is_possible=False)) is not None
