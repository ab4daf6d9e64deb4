"""Propose roles for the signals of a DBC or a table, by unit and by the words in their names."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from firmware_bridge.catalog import Catalog
from firmware_bridge.sources.table import TIME_NAMES, Table
from rtid.project.references import KIND_DIMENSIONS
from rtid.units import find_unit, units_of

_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_WANTED_NOT_MEASURED = {"ref", "reference", "set", "setpoint", "target", "desired", "demand", "des"}


@dataclass(frozen=True)
class Candidate:
    """A signal that could play a role; `message` is empty for a column of a table."""

    name: str
    message: str
    unit: str  # as the file says, "" if it says nothing
    low: float
    high: float
    guessed_unit: bool = False

    def words(self) -> set[str]:
        """Words of the name: "PSupply" -> p, supply."""
        return {word.lower() for word in _WORD.findall(self.name)}


@dataclass(frozen=True)
class Role:
    """A role and the words that speak for it; `alone` are whole names."""

    name: str
    kind: str
    words: frozenset[str]
    alone: frozenset[str]


def _role(name: str, kind: str, words: str, alone: str) -> Role:
    return Role(name, kind, frozenset(words.split()), frozenset(alone.split()))


ROLES = (
    _role("p_supply", "pressure", "supply pump system line sup", "ps p0 pp psys"),
    _role("p_tank", "pressure", "tank return reservoir drain", "pt pr pret"),
    _role("p_a", "pressure", "a cap bore head piston 1 bottom", "pa p1 pcap"),
    _role("p_b", "pressure", "b rod ring annulus 2 top", "pb p2 prod"),
    _role("x", "position", "x pos position stroke displacement length angle", "x s y"),
    _role("v", "velocity", "v vel velocity speed", "v xdot"),
    _role("u", "command", "u cmd command valve spool current pwm duty out", "u i uv"),
)


def from_catalog(catalog: Catalog) -> list[Candidate]:
    """Every signal of a DBC."""
    return [
        Candidate(s.name, m.name, s.unit or "", _number(s.minimum, 0), _number(s.maximum, 0))
        for m in (catalog.message(name) for name in catalog.names)
        for s in m.signals
    ]


def from_table(table: Table) -> list[Candidate]:
    """Every column of a table but time, with the range of its values."""
    found = []
    for name, column in table.columns.items():
        known = column[np.isfinite(column)]
        if name.lower() not in TIME_NAMES and len(known):
            low, high = float(known.min()), float(known.max())
            found.append(Candidate(name, "", table.units.get(name, ""), low, high))
    return found


def time_column(table: Table) -> str | None:
    """The column that looks like time."""
    return next((name for name in table.columns if name.lower() in TIME_NAMES), None)


def propose(candidates: list[Candidate]) -> dict[str, Candidate]:
    """The best candidate for each role; a signal plays one role, and a role may stay empty."""
    chosen: dict[str, Candidate] = {}
    for role in ROLES:
        left = [c for c in candidates if c not in chosen.values()]
        scored = [(_score(role, c), -len(c.name), k) for k, c in enumerate(left)]
        if scored and max(scored)[0] > 0:
            chosen[role.name] = _with_unit(left[max(scored)[2]], role)
    return chosen


def _score(role: Role, candidate: Candidate) -> float:
    """Positive if the candidate may play the role."""
    words = candidate.words()
    unit = find_unit(candidate.unit)
    fits = unit is not None and unit.dimension in KIND_DIMENSIONS[role.kind]
    if (candidate.unit and not fits) or (words & _WANTED_NOT_MEASURED and role.kind != "command"):
        return 0.0
    matched = len(words & role.words) + 2 * ("".join(sorted(words)) in role.alone)
    matched += 2 * (candidate.name.lower().replace("_", "") in role.alone)
    only_kind = fits and role.kind in ("position", "velocity", "command")
    if not matched and not only_kind:
        return 0.0
    foreign = len(words - role.words - {"p", "pressure", "press", "sensor"})
    return max(2 * matched + 2 * fits - 0.5 * foreign, 0.1)


def _with_unit(candidate: Candidate, role: Role) -> Candidate:
    """The candidate with a unit guessed from its range, if the file gives none."""
    if candidate.unit:
        return candidate
    size = max(abs(candidate.low), abs(candidate.high))
    limits = {"pressure": (1e5, 50e6), "position": (0.02, 5.0), "velocity": (0.005, 5.0)}
    if role.kind == "command":
        return replace(candidate, unit="V" if size <= 12 else "%", guessed_unit=True)
    low, high = limits[role.kind]
    dimension = KIND_DIMENSIONS[role.kind][0]
    fitting = [u.name for u in units_of(dimension) if low <= size * u.factor <= high]
    preferred = [n for n in ("Pa", "bar", "m", "mm", "m/s", "mm/s", "MPa") if n in fitting]
    unit = (preferred or fitting or [units_of(dimension)[0].name])[0]
    return replace(candidate, unit=unit, guessed_unit=True)


def _number(value: object, otherwise: float) -> float:
    return float(value) if isinstance(value, int | float) else otherwise


def relative(path: Path, folder: Path) -> str:
    """The path as the project file names it: relative to its folder where that is simple."""
    try:
        return path.resolve().relative_to(folder.resolve()).as_posix()
    except ValueError:
        return path.resolve().as_posix()
