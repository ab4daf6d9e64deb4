"""Valves that open within the band in which motion takes them for shut."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.diagnose.overlap import EarlierOpening
from rtid.diagnose.verdict import INSUFFICIENT, MATCHES, MISSING
from rtid.project import load
from rtid.study import quick_overlap
from rtid.study.quick_command import Reading
from rtid.study.quick_machine import of_band
from rtid.study.quick_overlap import below_its_band, opening_below
from rtid.study.quick_project import project_text
from rtid.trace.quick_source import Source
from tests.test_quick_pressures import MACHINE, ROLES, said

U = np.linspace(0.0, 6.0, 25)
SIZED = replace(MACHINE, u_grid=U, safe_band=0.0, assumptions=(of_band(0.0, MACHINE.command_unit),))


def reading(after: Any) -> tuple[Reading, Any]:
    """A first reading that names a seat leak, and what gives the study of another one."""
    result = SimpleNamespace(last=None)
    first: Any = SimpleNamespace(diagnosed=SimpleNamespace(result=result))
    other = SimpleNamespace(diagnosis=lambda: after, path="")
    return Reading(first, SIZED, said(MISSING, "valve_seat_leakage")), lambda _: other


@pytest.mark.parametrize(
    ("won", "after", "band"),
    [
        (900.0, said(MATCHES), -0.5),
        (900.0, said(INSUFFICIENT, rho=0.8), -0.5),
        (900.0, said(INSUFFICIENT, rho=3.0), 0.0),
        (5.0, said(MATCHES), 0.0),
        (-900.0, said(MATCHES), 0.0),
    ],
)
def test_an_opening_is_taken_where_it_is_likelier(
    monkeypatch: pytest.MonkeyPatch, won: float, after: Any, band: float
) -> None:
    opening = EarlierOpening(2, None, won, 12.0)  # type: ignore[arg-type]
    monkeypatch.setattr(quick_overlap, "likeliest_opening", lambda _: opening)
    assert below_its_band(*reading(after)).machine.safe_band == pytest.approx(band)


def test_the_project_opens_its_maps_below_zero(tmp_path: Any) -> None:
    machine = opening_below(SIZED, 2)
    assert np.allclose(machine.u_grid, np.linspace(-0.5, 6.0, 27))
    (assumption,) = machine.assumptions
    assert "-0.5 V of the other direction" in assumption.what
    source = Source({"time_column": "t", "time_unit": "s"}, [], {}, {})
    file = tmp_path / "machine.toml"
    file.write_text(project_text("m", source, ROLES, machine), "utf-8")
    assert {edge.safe_band_v for edge in load(file).model.edges} == {-0.5}
