"""Whether the pressures of a file count from nothing or from the air."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from rtid.diagnose.verdict import AMBIGUOUS, MATCHES, MISSING, UNKNOWN
from rtid.project.guess import RoleCandidate
from rtid.study import quick_pressures
from rtid.study.quick_command import Reading
from rtid.study.quick_machine import Given, first_machine
from rtid.study.quick_pressures import counted_from_air, from_air
from rtid.study.quick_project import project_text
from rtid.trace.quick_source import Source

ROLES = {
    "u": RoleCandidate("u", "", "V", -10.0, 10.0),
    "x": RoleCandidate("x", "", "mm", 0.0, 400.0),
    "p_a": RoleCandidate("p_a", "", "bar", 0.5, 60.0),
    "p_b": RoleCandidate("p_b", "", "MPa", 0.5, 6.0),
}
MACHINE = first_machine(ROLES, Given())


def said(verdict: str, *names: str, rho: float = 1.0) -> Any:
    found = tuple(SimpleNamespace(effect=name, where="both", alike=()) for name in names)
    return SimpleNamespace(verdict=verdict, found=found, rho_after=rho)


def reading(before: Any, after: Any, unit: str = "bar") -> tuple[Any, Any]:
    """A first reading, and what gives the study of another one."""
    signals = {"p_a": SimpleNamespace(unit=unit)}
    project = SimpleNamespace(sections=SimpleNamespace(signals=signals))
    first: Any = SimpleNamespace(project=project, fitted=None)
    other = SimpleNamespace(diagnosis=lambda: after, path="")
    return Reading(first, MACHINE, before), lambda _: other


@pytest.mark.parametrize(
    ("won", "before", "after", "is_taken"),
    [
        (30.0, said(UNKNOWN, rho=6.0), said(MISSING, "entrained_air"), True),
        (0.0, said(UNKNOWN, rho=6.0), said(MISSING, "entrained_air"), True),
        (-30.0, said(UNKNOWN, rho=6.0), said(MISSING, "entrained_air"), False),
        (30.0, said(UNKNOWN, rho=6.0), said(MISSING, "hose_compliance"), False),
        (30.0, said(UNKNOWN, rho=6.0), said(UNKNOWN, rho=2.0), False),
        (30.0, said(AMBIGUOUS, "entrained_air"), said(MISSING, "entrained_air"), True),
        (0.0, said(MISSING, "entrained_air"), said(MISSING, "entrained_air"), False),
    ],
)
def test_the_reading_that_has_a_name_for_the_air_is_taken(
    monkeypatch: pytest.MonkeyPatch, won: float, before: Any, after: Any, is_taken: bool
) -> None:
    monkeypatch.setattr(quick_pressures, "wins_from_air", lambda _: (won, 12.0))
    assert from_air(*reading(before, after)).machine.pressures_from_air is is_taken


def test_where_nothing_tells_it_is_an_assumption(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quick_pressures, "wins_from_air", lambda _: (0.0, 12.0))
    kept = from_air(*reading(said(MISSING, "entrained_air"), said(MATCHES)))
    assert "absolute" in kept.machine.assumptions[-1].what


def test_pressures_that_say_so_are_not_asked() -> None:
    first, at = reading(said(UNKNOWN), said(MATCHES), unit="barg")
    assert from_air(first, at) is first


def test_the_project_adds_the_pressure_of_the_air() -> None:
    source = Source({"time_column": "t", "time_unit": "s"}, [], {}, {})
    sized = replace(MACHINE, safe_band=0.5)
    plain = project_text("m", source, ROLES, sized)
    text = project_text("m", source, ROLES, counted_from_air(sized))
    assert "offset" not in plain
    assert "offset = 1.01325\n" in text and "offset = 0.101325\n" in text
