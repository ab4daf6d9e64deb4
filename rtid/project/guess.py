"""Propose roles for the signals of a DBC or a table, by unit and by the words in their names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from firmware_bridge.catalog import Catalog
from firmware_bridge.sources.table import Table, is_time
from rtid.errors import RtidError
from rtid.project.references import KIND_DIMENSIONS
from rtid.units import COMMAND_DIMENSIONS, find_unit, nearest, said, split_name, units_of, words_of

_PRESSURE = {"p", "pressure", "press", "pres", "prs", "druck", "pression", "pressao", "cisnienie"}
_WANTED_NOT_MEASURED = {"ref", "reference", "set", "setpoint", "target", "desired", "demand", "des"}
_WANTED_NOT_MEASURED |= {"soll", "sollwert"}
# What the messages of an engine, a gearbox and a cab speak of, and no cylinder
_ELSEWHERE = {
    *("engine", "eng", "vehicle", "wheel", "fuel", "coolant", "brake", "tire", "tyre", "intake"),
    *("exhaust", "turbo", "turbocharger", "boost", "manifold", "rail", "crankcase", "air", "fan"),
    *("transmission", "trans", "clutch", "gear", "retarder", "battery", "ambient", "barometric"),
    *("accelerator", "accel", "pedal", "steering", "def", "scr", "filter", "cruise"),
}
MOST_PERCENT = 400.0  # a command of larger numbers counts
# SI values between which the largest of a signal lies, the likeliest first: 40 to 700 bar
LARGEST = {
    "pressure": ((4e6, 70e6), (1e6, 70e6), (1e5, 70e6)),
    "position": ((0.02, 5.0),),
    "velocity": ((0.005, 5.0),),
}
_PATH, _DEVICE = re.compile(r"::|[./]"), re.compile(r"(?:\\[\w:]+|:\d+)$")  # p_s\CCP:1
_KIN = 0.25  # for each word that two signals of one cylinder share


@dataclass(frozen=True)
class RoleCandidate:
    """A signal that could play a role; `message` is empty for a column of a table."""

    name: str
    message: str
    unit: str  # as the file or the name says, "" if neither says anything
    low: float
    high: float
    guessed_unit: bool = False

    @property
    def stem(self) -> str:
        """The name without its unit."""
        return split_name(self.name)[0]

    @property
    def last_name(self) -> str:
        """The stem without the path before it, and the port or device behind: "Press::p_s:1"."""
        return _PATH.split(_DEVICE.sub("", self.stem))[-1]

    @property
    def full_name(self) -> str:
        """Message and signal, or the column."""
        return f"{self.message}.{self.name}".lstrip(".")


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
    _role(
        "p_supply",
        "pressure",
        "supply pump pmp system main line sup outlet pumpe pumpendruck systemdruck speisedruck "
        "versorgung versorgungsdruck zulauf zulaufdruck pompe bomba alimentation alimentacao "
        "zasilania zasilanie pompy",
        "ps p0 pp psys pressp presp pressurep druckp",
    ),
    _role(
        "p_tank",
        "pressure",
        "tank return reservoir drain tankdruck ruecklauf ruecklaufdruck ablauf ablaufdruck "
        "retour retorno tanque powrotu powrot zbiornika zbiornik",
        "pt pr pret",
    ),
    _role(
        "p_a",
        "pressure",
        "a cap bore head piston 1 bottom base extend kolbendruck kolbenseite kolbenraum bodenseite "
        "pistao tloka",
        "pa p1 pcap",
    ),
    _role(
        "p_b",
        "pressure",
        "b rod ring annulus 2 top retract stangendruck ringdruck stangenseite stangenraum "
        "ringseite ringraum haste tloczyska",
        "pb p2 prod",
    ),
    _role(
        "x",
        "position",
        "x pos position stroke displacement length extension angle weg kolbenweg zylinderweg hub "
        "zylinderhub posicao curso deslocamento polozenie pozycja przemieszczenie",
        "x s y",
    ),
    _role("v", "velocity", "v vel velocity speed geschwindigkeit predkosc", "v xdot"),
    _role(
        "u",
        "command",
        "u cmd command valve vlv vpoc spool coil solenoid current pwm duty out voltage "
        "ventil ventilstrom ventilspannung stellsignal stellgroesse sollwert commande comando "
        "valvula sterowanie zaworu",
        "u i uv",
    ),
)


def from_catalog(catalog: Catalog) -> list[RoleCandidate]:
    """Every signal of a DBC."""
    return [
        RoleCandidate(
            s.name, name, unit_said(s.name, s.unit), _number(s.minimum, 0), _number(s.maximum, 0)
        )
        for name in catalog.names
        for s in catalog.message(name).signals
    ]


def from_table(table: Table) -> list[RoleCandidate]:
    """Every column of a table but time, with the range of its values."""
    candidates = []
    for name, column in table.columns.items():
        known = column[np.isfinite(column)]
        if not is_time(name) and len(known):
            low, high = float(known.min()), float(known.max())
            candidates.append(
                RoleCandidate(name, "", unit_said(name, table.units.get(name)), low, high)
            )
    return candidates


def unit_said(name: str, given: str | None) -> str:
    """Unit of a signal as its file gives it, else as its name tells; "" if neither does."""
    return said(given or "") or split_name(name)[1]


def propose(candidates: list[RoleCandidate]) -> dict[str, RoleCandidate]:
    """The best candidate for each role; a signal plays one role, and a role may stay empty.

    Of several cylinders on a bus one is taken: with what its surest signal shares words.
    """
    roles = _chosen(candidates, None)
    anchor = next((roles[name] for name in ("p_a", "p_b", "x") if name in roles), None)
    kin = _chosen(candidates, anchor)
    return {role.name: with_unit(kin[role.name], role) for role in ROLES if role.name in kin}


def _chosen(
    candidates: list[RoleCandidate], anchor: RoleCandidate | None
) -> dict[str, RoleCandidate]:
    """The candidates by role, the surest pair first; anchor: a signal of the cylinder."""
    pairs = [
        (_score(role, c) and _score(role, c) + _kinship(c, anchor), -k, -len(c.name), -j)
        for k, role in enumerate(ROLES)
        for j, c in enumerate(candidates)
    ]
    chosen: dict[int, int] = {}  # role -> candidate, the surest pair first
    for score, k, _, j in sorted(pairs, reverse=True):
        if score > 0 and -k not in chosen and -j not in chosen.values():
            chosen[-k] = -j
    return {ROLES[k].name: candidates[j] for k, j in chosen.items()}


def _kinship(candidate: RoleCandidate, anchor: RoleCandidate | None) -> float:
    """How much a signal looks like one of the same cylinder."""
    if anchor is None:
        return 0.0
    shared = words_of(candidate.stem) & words_of(anchor.stem) - _PRESSURE
    return _KIN * (len(shared) + (candidate.message == anchor.message))


def unused(candidates: list[RoleCandidate], roles: dict[str, RoleCandidate]) -> list[RoleCandidate]:
    """The candidates that play no role."""
    used = {(c.message, c.name) for c in roles.values()}
    return [c for c in candidates if (c.message, c.name) not in used]


def with_named(
    roles: dict[str, RoleCandidate], given: Mapping[str, RoleCandidate]
) -> dict[str, RoleCandidate]:
    """Guessed roles with those that the user has named; a named signal plays no other role."""
    taken = {(c.message, c.name) for c in given.values()}
    return {r: c for r, c in roles.items() if (c.message, c.name) not in taken} | dict(given)


def named(candidates: list[RoleCandidate], given: Mapping[str, str]) -> dict[str, RoleCandidate]:
    """The signals that the user has named for roles; RtidError for a name that is none."""
    known = {c.full_name: c for c in candidates} | {c.name: c for c in candidates}
    kinds = {role.name: role for role in ROLES}
    for role, name in given.items():
        if role not in kinds or name not in known:
            near = nearest(role, list(kinds)) if role not in kinds else nearest(name, list(known))
            what = "role" if role not in kinds else "signal"
            raise RtidError(f"--role {role}={name}: no such {what}", near, 2)
    return {role: with_unit(known[name], kinds[role]) for role, name in given.items()}


def may_be(role: str, candidate: RoleCandidate) -> bool:
    """Whether a signal may play the role of this name."""
    return any(_score(known, candidate) > 0.0 for known in ROLES if known.name == role)


def is_wanted(candidate: RoleCandidate) -> bool:
    """Whether a name says that its signal is wanted, and not measured."""
    return bool(words_of(candidate.stem) & _WANTED_NOT_MEASURED)


def _score(role: Role, candidate: RoleCandidate) -> float:
    """Positive if the candidate may play the role."""
    words = words_of(candidate.stem)
    if role.kind == "velocity":  # a "_V" behind other words are volts
        words = words_of(split_name(candidate.name, COMMAND_DIMENSIONS)[0])
    unit = find_unit(candidate.unit)
    fits = unit is not None and unit.dimension in KIND_DIMENSIONS[role.kind]
    if (candidate.unit and not fits) or (words & _WANTED_NOT_MEASURED and role.kind != "command"):
        return 0.0
    if words & _ELSEWHERE:
        return 0.0
    known = role.words
    if any(word in known and not word.isdigit() for word in words):
        words = {word for word in words if not word.isdigit()}  # p_b2 is one of the second cylinder
    if role.kind == "pressure" and not (fits or words & _PRESSURE):
        known = frozenset(word for word in known if len(word) > 1)  # motor_1 is no chamber
    matched = len(words & known) + 2 * ("".join(sorted(words)) in role.alone)
    matched += 2 * (candidate.last_name.lower().replace("_", "") in role.alone)
    only_kind = fits and role.kind in ("position", "velocity", "command")
    if not matched and not only_kind:
        return 0.0
    foreign = len(words - role.words - _PRESSURE - {"sensor"})
    return max(2 * matched + 2 * fits - 0.5 * foreign, 0.1)


def with_unit(candidate: RoleCandidate, role: Role) -> RoleCandidate:
    """The candidate with a unit guessed from its range, if the file gives none."""
    if candidate.unit:
        return candidate
    size = max(abs(candidate.low), abs(candidate.high))
    if role.kind == "command":
        unit = "V" if size <= 12 else "%" if size <= MOST_PERCENT else "PWM"
        return replace(candidate, unit=unit, guessed_unit=True)
    dimension = KIND_DIMENSIONS[role.kind][0]
    names = (_likely(size, dimension, *limits) for limits in LARGEST[role.kind])
    unit = next((name for name in names if name), units_of(dimension)[0].name)
    return replace(candidate, unit=unit, guessed_unit=True)


def _likely(size: float, dimension: str, low: float, high: float) -> str:
    """The unit in which the largest value of a signal lies between two SI values; "" if none."""
    fitting = [u.name for u in units_of(dimension) if low <= size * u.factor <= high]
    fitting = [name for name in fitting if name != "um"]  # of that size are a converter's counts
    preferred = [n for n in ("Pa", "bar", "m", "mm", "m/s", "mm/s", "MPa") if n in fitting]
    return (preferred or fitting or [""])[0]


def is_beyond_units(candidate: RoleCandidate, kind: str) -> bool:
    """Whether values in a unit that was guessed are no machine's in any: they may be counts."""
    unit = find_unit(candidate.unit)
    least = 0.0 if kind == "position" else min(low for low, _ in LARGEST[kind])  # strokes are short
    most = max(high for _, high in LARGEST[kind])
    size = max(abs(candidate.low), abs(candidate.high))
    is_one = unit is not None and (size == 0.0 or least <= size * unit.factor <= most)
    return candidate.guessed_unit and not is_one


def _number(value: object, otherwise: float) -> float:
    return float(value) if isinstance(value, int | float) else otherwise


def relative(path: Path, folder: Path) -> str:
    """The path as the project file names it: relative to its folder where that is simple."""
    try:
        return path.resolve().relative_to(folder.resolve()).as_posix()
    except ValueError:
        return path.resolve().as_posix()
