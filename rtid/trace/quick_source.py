"""Open a file of which nobody has said anything: its signals, with units and ranges of the data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import NoReturn

import numpy as np

from firmware_bridge import catalog as catalogs
from firmware_bridge.catalog import Catalog
from firmware_bridge.frames import Frames
from firmware_bridge.sources import open_file
from firmware_bridge.sources.table import MINUS, Table
from rtid.errors import RtidError
from rtid.plain import IntArray
from rtid.project import guess as proposal
from rtid.project.guess import RoleCandidate
from rtid.trace.described import by_message
from rtid.trace.steady import period_of
from rtid.trace.table import time_of
from rtid.units import Unit, find_unit, split_name

NEEDED = {
    "u": "the command of the valves",
    "x": "the position of the piston",
    "p_a": "the pressure of the chamber that grows with x",
    "p_b": "the pressure of the other chamber",
}
UNITS_OF = {
    "pressure": "write Pa, kPa, MPa, bar, mbar or psi in its place; barg and psig count from the "
    "air",
    "length": "write mm, cm, m, um or in in its place",
    "a command": "write V, mV, A, mA, %, ‰ or counts in its place, or nothing",
}
NOBODY: Mapping[str, RoleCandidate] = MappingProxyType({})
ACTS = 0.02  # share of its largest value from which on a command acts, and of the time that it does
SAME_TIME = 0.5  # share of rows with the time of the one before, from which on time tells nothing
LEAST_STEP = 1e-6  # of a signal's range: computed values have no noise of their own


@dataclass(frozen=True)
class Source:
    """What a file offers: keys of [source], all signals, messages with their period in ms.

    steps: smallest change of a column of a table, in its unit; step_ms: its usual step in time.
    Of a bus the DBC and the periods tell both.  channels: which one is taken of messages that come
    on several.
    """

    keys: dict[str, str]
    signals: list[RoleCandidate]
    periods_ms: dict[str, float]
    steps: dict[str, float]
    step_ms: float = 0.0
    channels: dict[str, int] = field(default_factory=dict)


def open_source(path: Path, dbc: Path | None) -> Source:
    """Open a table or a CAN log.  Raises RtidError, and the readers' errors."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "no such file"
        raise RtidError(f"{path}: {what}", "name a table or a CAN log", 2)
    content = open_file(path)
    if isinstance(content, Table):
        return _of_table(content)
    return log_source(path, content, dbc)


def _of_table(table: Table) -> Source:
    from rtid.trace.series import smallest_step  # noqa: PLC0415 - it brings the estimator with it

    time, unit = time_of(table)
    signals = proposal.from_table(table)
    _refuse_unread(table, signals)
    signals = _one_command(table, signals)
    steps = {}
    for candidate in signals:
        values = table.column(candidate.name)
        span = candidate.high - candidate.low
        steps[candidate.name] = max(smallest_step(values[np.isfinite(values)]), LEAST_STEP * span)
    t_us = table.t_us()
    _refuse_coarse_stamps(table, time, t_us)
    step_ms = 1e-3 * period_of(t_us) if len(t_us) > 1 else 0.0
    return Source({"time_column": time, "time_unit": unit}, signals, {}, steps, step_ms)


def _refuse_unread(table: Table, signals: list[RoleCandidate]) -> None:
    """RtidError where a column would play a role that none of the signals plays, were it read."""
    titles = {split_name(title)[0]: title for title in table.unread}
    texts = [RoleCandidate(split_name(t)[0], "", split_name(t)[1], 0.0, 0.0) for t in table.unread]
    played = proposal.propose(signals).keys()
    lost = [
        titles[candidate.name]
        for role, candidate in proposal.propose([*signals, *texts]).items()
        if role not in played and candidate.name in titles
    ]
    if lost:
        raise RtidError(
            f"{table.path}: " + "; ".join(f"{title}: {table.unread[title]}" for title in lost),
            "write plain numbers, 1234.5: no separators of thousands, no units in the fields",
        )


def _refuse_coarse_stamps(table: Table, time: str, t_us: IntArray) -> None:
    """RtidError where most rows tell something new at the time of the row before; t_us (n,).

    What a row does not tell is nothing new: signals of one time may come in rows in turn.
    """
    stands = np.diff(t_us) == 0
    if len(t_us) < 3 or np.mean(stands) <= SAME_TIME:
        return
    others = [column for name, column in table.columns.items() if name != time]
    is_new = np.any([np.abs(np.diff(column)) > 0.0 for column in others], axis=0)
    if np.mean(stands & is_new) <= SAME_TIME:
        return
    raise RtidError(
        f"{table.path}: {len(np.unique(t_us))} times for {len(t_us)} rows: {time} is coarser than "
        "its rows come, or in another unit",
        f'log times as fine as the rows, or name the unit, "{time} [ms]"; "{time} [d]" of days, as '
        "spreadsheets keep dates",
    )


def _one_command(table: Table, signals: list[RoleCandidate]) -> list[RoleCandidate]:
    """The signals of a cylinder, its two commands, one for each direction, in one: "out - in"."""
    if not {"p_a", "p_b"} <= proposal.propose(signals).keys():
        return signals
    commands = [c for c in signals if -c.low <= ACTS * c.high > 0.0 and proposal.may_be("u", c)]
    for k, first in enumerate(commands):
        for second in commands[k + 1 :]:
            if first.unit == second.unit and _take_turns(table, first, second):
                name = f"{first.name}{MINUS}{second.name}"
                both = replace(first, name=name, low=-second.high)
                return [both if c is first else c for c in signals if c is not second]
    return signals


def _take_turns(table: Table, first: RoleCandidate, second: RoleCandidate) -> bool:
    """Whether both act, and at once only where one goes and the other comes."""
    values = np.array([table.column(c.name) for c in (first, second)])
    values = values[:, np.isfinite(values).all(axis=0)]  # rows may tell them in turn
    acts = values > ACTS * np.array([[first.high], [second.high]])
    shares = acts.mean(axis=1) if acts.size else np.zeros(2)
    return bool(shares.min() > ACTS and acts.all(axis=0).mean() <= ACTS * shares.min())


def log_source(path: Path, frames: Frames, dbc: Path | None) -> Source:
    """What a log offers by a DBC, rtid's own if none is named.  RtidError if it describes none."""
    if not len(frames):
        _refuse_empty(path, frames)
    places = catalogs.places(dbc) if dbc else catalogs.places()
    catalog = catalogs.load(places)
    every = {n: f for n, f in by_message(frames, catalog).items() if len(f) > 1}
    chosen = {n: int(np.bincount(f.channel).argmax()) for n, f in every.items()}
    messages = {n: f[f.channel == chosen[n]] for n, f in every.items()}
    several = {n: c for n, c in chosen.items() if len(messages[n]) < len(every[n])}
    if not messages:
        ids = sorted({int(i) & 0x1FFFFFFF for i in np.unique(frames.can_id)})
        shown = ", ".join(f"0x{i:X}" for i in ids[:8]) + (", ..." if len(ids) > 8 else "")
        of = f"{dbc} describes" if dbc else "the built-in DBC describes"
        raise RtidError(
            f"{path}: none of its {len(frames)} frames is what {of}; ids: {shown or 'none'}",
            "name the DBC of this bus: --dbc FILE" if dbc is None else "is it the right DBC?",
        )
    signals = [c for name, mine in messages.items() for c in _signals(mine, name, catalog)]
    periods = {name: 1e-3 * period_of(f.t_us) for name, f in messages.items()}
    name = ", ".join(place.named(str(place.file.resolve())) for place in places)
    keys = {"dbc": name if dbc else f"{catalogs.BUILTIN}controller.dbc"}
    return Source(keys, signals, periods, {}, channels=several)


def _refuse_empty(path: Path, frames: Frames) -> NoReturn:
    """No DBC helps where a log holds remote frames, errors, or nothing; it says what it holds."""
    counts = ", ".join(f"{reason} {n}" for reason, n in frames.refused.items() if n)
    raise RtidError(
        f"{path}: it holds no data frames; refused: {counts or 'nothing'}",
        "record the bus while the machine moves; `rtid check FILE --bus-only` looks at a capture",
    )


def _signals(frames: Frames, name: str, catalog: Catalog) -> list[RoleCandidate]:
    """The signals of a message with the range of what was sent."""
    layouts = catalog.layouts(name)
    values, candidates = layouts.decode(frames.data), []
    for k, signal in enumerate(layouts.names):
        known = values[np.isfinite(values[:, k]), k]
        if len(known):
            unit = proposal.unit_said(signal, catalog.signal(name, signal).unit)
            candidates.append(
                RoleCandidate(signal, name, unit, float(known.min()), float(known.max()))
            )
    return candidates


def roles_of(
    path: Path, source: Source, given: Mapping[str, RoleCandidate] = NOBODY
) -> dict[str, RoleCandidate]:
    """Who plays which role, all pressures of unknown unit in the same one; given: as named.

    Raises RtidError naming what is missing and what there is.
    """
    roles = proposal.with_named(proposal.propose(source.signals), given)
    missing = [f"{what} ({role})" for role, what in NEEDED.items() if role not in roles]
    if missing:
        there = ", ".join(f"{c.name} [{c.unit or '?'}]" for c in source.signals[:20]) or "nothing"
        raise RtidError(
            f"{path}: found no signal that could be {'; nor '.join(missing)}. It has: {there}",
            'call the columns u, x, p_a, p_b, with units as in "p_a [bar]", or say what is what '
            "in a project file: rtid init",
        )
    unit = find_unit(roles["x"].unit)
    if unit is not None and unit.dimension == "angle" and not is_motor(roles):
        raise RtidError(
            f"{path}: {roles['x'].name} is an angle, and only you know what position it means",
            "write a project file with its table: rtid init",
        )
    _refuse_no_unit(path, roles["x"], "position", "length")
    roles = _alike(roles)
    pressures = (c for r, c in roles.items() if r.startswith("p_"))
    _refuse_no_unit(path, max(pressures, key=lambda c: abs(c.high)), "pressure", "pressure")
    return roles


def _refuse_no_unit(path: Path, of: RoleCandidate, kind: str, what: str) -> None:
    """RtidError for a signal without a unit whose size is none of a machine in any."""
    if proposal.is_beyond_units(of, kind):
        example = {"length": "mm", "pressure": "bar"}[what]
        raise RtidError(
            f"{path}: {of.name} goes from {of.low:.4g} to {of.high:.4g}: in no unit of {what}",
            f"counts of a converter? Give {what}s, with the unit in the name, "
            f'"{of.stem}_{example}"',
        )


def refuse_unknown_units(path: Path, source: Source, roles: Mapping[str, RoleCandidate]) -> None:
    """RtidError where a signal plays no role of a cylinder for its unit alone.

    Chambers' pressures of a unit that nobody knows; beside them a position and a command of any.
    """
    known = {(c.message, c.name) for c in roles.values()}
    bare = [replace(c, unit="") if not find_unit(c.unit) else c for c in source.signals]
    _refuse_lost(path, "pressure", _lost(source, bare, ("p_a", "p_b"), roles))
    if {"p_a", "p_b"} <= roles.keys():
        bare = [c if (c.message, c.name) in known else replace(c, unit="") for c in source.signals]
        _refuse_lost(path, "length", _lost(source, bare, ("x",), roles))
        _refuse_lost(path, "a command", _lost(source, bare, ("u",), roles))


def _refuse_lost(path: Path, kind: str, lost: list[RoleCandidate]) -> None:
    if not lost:
        return
    units = ", ".join(f"{c.name} [{c.unit}]" for c in lost)
    remedy = UNITS_OF[kind]
    if kind == "length" and lost[0].unit == "%":
        remedy = f'give it in mm, "{lost[0].stem} [mm]": 1 % is a hundredth of the stroke'
    raise RtidError(f"{path}: {units}: no unit of {kind} that is known", remedy)


def _lost(
    source: Source,
    bare: list[RoleCandidate],
    wanted: Sequence[str],
    roles: Mapping[str, RoleCandidate],
) -> list[RoleCandidate]:
    """The signals that would play a role of those wanted, which nobody plays, but for their unit.

    bare: the same signals, some of them without one.
    """
    without = proposal.propose(bare)
    played = (without[r] for r in wanted if r in without and r not in roles)
    names = [(c.message, c.name) for c in played if c.guessed_unit]
    return [c for c in source.signals if c.unit and (c.message, c.name) in names]


def is_motor(roles: Mapping[str, RoleCandidate]) -> bool:
    """True where the position is an angle that goes beyond one turn."""
    x, unit = roles["x"], unit_of(roles["x"])
    return unit.dimension == "angle" and unit.factor * (x.high - x.low) > math.tau


def _alike(roles: dict[str, RoleCandidate]) -> dict[str, RoleCandidate]:
    """Pressures whose unit was guessed in the unit of the largest of them."""
    guessed = {r: c for r, c in roles.items() if r.startswith("p_") and c.guessed_unit}
    if not guessed:
        return roles
    unit = max(guessed.values(), key=lambda c: abs(c.high)).unit
    return roles | {role: replace(c, unit=unit) for role, c in guessed.items()}


def unit_of(candidate: RoleCandidate) -> Unit:
    """The unit of a role's signal, which is known or guessed."""
    unit = find_unit(candidate.unit)
    assert unit is not None, "roles have units that are known, or guessed ones"
    return unit
