"""A valve that opens within its band is no seat leak, and a seat leak no opening."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtid.diagnose import overlap
from rtid.diagnose.fit import Fit
from rtid.diagnose.overlap import (
    SHARE,
    EarlierOpening,
    beside_openings,
    likeliest_opening,
    opened_earlier,
    seats,
)
from rtid.diagnose.residual import Residual
from rtid.diagnose.standing import on_its_grid
from rtid.diagnose.trials import AcceptedEffect
from rtid.model import Grid, Machine
from rtid.plain import FloatArray, Key
from tests.diagnose.records import record

LATE_V = 2.4  # beyond the dead bands, of 1.5 to 2 V: what is declared to be shut is open


def shut_too_long(model: Machine) -> Machine:
    """The machine with bands beyond the commands at which its valves open."""
    u = np.linspace(LATE_V, float(model.edges[0].grid.u_v[-1]), 20)
    edges = (replace(e, safe_band_v=LATE_V, grid=Grid(u, e.grid.dp_pa)) for e in model.edges)
    return replace(model, edges=tuple(edges))


def seen(effect: str = "", strength: float = 0.0, *, late: bool = False) -> Fit:
    model, chunk, _ = record(effect, strength)
    return on_its_grid(shut_too_long(model) if late else model, chunk)


def accepted(key: Key, *alike: Key) -> AcceptedEffect:
    none: FloatArray = np.zeros((0, 2))
    rest = Residual(none[:, 0], none, none, none)
    return AcceptedEffect(key, alike, 400.0, 1, rest, rest)


def test_an_earlier_opening_adds_blocks_below_the_band() -> None:
    model, _, _ = record()
    bands = (0.0, 1.0, -1.0, -np.inf)
    edges = [replace(e, safe_band_v=b) for e, b in zip(model.edges, bands, strict=True)]
    earlier = opened_earlier(replace(model, edges=tuple(edges)), 2)
    for before, now in zip(edges, earlier.edges, strict=True):
        if np.isinf(before.safe_band_v):
            assert now is before
            continue
        step = SHARE * np.ptp(before.grid.u_v)
        assert now.safe_band_v == now.grid.u_v[0]
        assert now.safe_band_v == pytest.approx(before.grid.u_v[0] - 2 * step)
        assert np.array_equal(now.grid.u_v[2:], before.grid.u_v)


def test_what_a_valve_passes_within_its_band_is_an_opening() -> None:
    present = seen(late=True)
    opening = likeliest_opening(present)
    assert present.rho > 3.0, "valves that are declared shut are open"
    assert opening is not None and opening.is_likelier and opening.fit.rho < 0.5 * present.rho
    found = [accepted(("valve_seat_leakage", "pa")), accepted(("relief_valve", "b"))]
    (seat,) = beside_openings(found, present)
    assert seat.alike == (("deadband_shift", "pa"),), "what only made up for it is gone"


def test_valves_that_are_shut_within_their_band_have_no_earlier_opening() -> None:
    opening = likeliest_opening(seen())
    assert opening is not None and not opening.is_likelier


def test_what_is_not_told_from_a_seat_leak_is_no_opening_of_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where nothing speaks for one: the band was declared to be shut."""
    present: Fit = None  # type: ignore[assignment]
    monkeypatch.setattr(
        overlap, "likeliest_opening", lambda _: EarlierOpening(1, present, 5.0, 12.0)
    )
    leak, seat = ("external_leakage_laminar", "b"), ("valve_seat_leakage", "bt")
    assert beside_openings([accepted(leak, seat)], present)[0].alike == (seat,)
    assert beside_openings([accepted(seat)], present)[0].alike == (("deadband_shift", "bt"),)


def test_without_a_seat_leak_nothing_is_asked() -> None:
    found = [accepted(("relief_valve", "b"))]
    nothing: Fit = None  # type: ignore[assignment]
    assert beside_openings(found, nothing) is found


def test_what_goes_on_below_a_band_is_a_page_that_says_so() -> None:
    assert seats() == {"valve_seat_leakage"}
