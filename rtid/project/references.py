"""Checks across sections: every name that one section uses must exist in another, and fit.

They work on the tables as written, so that a section with another error is still checked.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from firmware_bridge.catalog import Catalog
from rtid.model import OTHER
from rtid.project.errors import Problem
from rtid.project.sections import Raw, key_of
from rtid.units import COMMAND_DIMENSIONS, UNITS, find_unit, nearest, units_of

KINDS = {
    "pressure": "pressure",
    "length": "position",
    "angle": "position",
    "velocity": "velocity",
    "mode": "mode",
} | dict.fromkeys(COMMAND_DIMENSIONS, "command")
OTHERS = ("force", "acceleration", "temperature", "rotation", "flow", "mass")
KIND_DIMENSIONS = {
    "command": COMMAND_DIMENSIONS,
    "pressure": ("pressure",),
    "position": ("length", "angle"),
    "velocity": ("velocity",),
    "mode": ("mode",),
}
# Which signal kind each reference needs: (section, key) -> kind.
REFERENCES = {
    ("chambers", "pressure"): "pressure",
    ("edges", "source"): "pressure",
    ("edges", "sink"): "pressure",
    ("edges", "command"): "command",
}
TEXT_KEYS = {
    *("dbc", "message", "signal", "column", "unit", "kind", "counter", "crc", "of"),
    *("pressure", "position", "source", "sink", "command", "reference_map", "state", "over"),
    "measured",
}
EDGE_NEEDS = {
    "u_grid": "u_grid_v = [1.0, {start = 1.5, stop = 4.0, step = 0.25}, 7.0]",
    "dp_grid": "dp_grid_mpa = [0.0, 1.0, 2.0, 4.0, 7.0]",
    "rated_flow": "rated_flow_lpm = 30, the flow at rated_dp",
    "rated_dp": "rated_dp_mpa = 0.5",
}


def table(raw: Raw, section: str) -> Raw:
    """A section as written, without keys that should be text and are not (named elsewhere)."""
    section_table = raw.get(section)
    entries = section_table.items() if isinstance(section_table, dict) else ()
    return {k: value for k, value in entries if k not in TEXT_KEYS or isinstance(value, str)}


def tables(raw: Raw, section: str) -> dict[str, Raw]:
    """The well-formed sub-tables of a section, e.g. all [edges.NAME]."""
    value = raw.get(section)
    entries = value.items() if isinstance(value, dict) else ()
    return {name: table({name: entry}, name) for name, entry in entries if isinstance(entry, dict)}


def kind_of(signal: Raw, dbc_unit: str | None = None) -> str | None:
    """The kind as given, or as the unit tells; None if neither does."""
    kind, unit = signal.get("kind"), find_unit(str(signal.get("unit") or dbc_unit or ""))
    if isinstance(kind, str):
        return kind
    if signal.get("table"):
        return "position"
    if unit and unit.dimension in OTHERS:
        return OTHER
    return KINDS.get(unit.dimension) if unit else None


def find_dbc_unit(signal: Raw, catalog: Catalog | None) -> str | None:
    """Unit that the DBC gives for this signal."""
    if catalog is None or not {"message", "signal"} <= set(signal):
        return None
    if signal["message"] not in catalog.names:
        return None
    names = {s.name: s.unit for s in catalog.message(signal["message"]).signals}
    return names.get(signal["signal"])


def check(raw: Raw, catalog: Catalog | None, folder: Path) -> Iterator[Problem]:
    """All problems between sections."""
    kinds = {n: kind_of(s, find_dbc_unit(s, catalog)) for n, s in tables(raw, "signals").items()}
    for name, signal in tables(raw, "signals").items():
        yield from _signal(f"signals.{name}", signal, kinds[name], catalog, raw)
    yield from _averaged(raw, kinds)
    yield from _named_signals(raw, kinds)
    yield from _controller(raw, kinds)
    yield from _rate(raw, kinds) if "rate" in raw else _position(raw, kinds)
    yield from _stroke(raw)
    for name, chamber in tables(raw, "chambers").items():
        yield from _chamber(f"chambers.{name}", chamber)
    for name, edge in tables(raw, "edges").items():
        yield from _edge(f"edges.{name}", edge, raw, kinds, catalog, folder)
    yield from _prior(table(raw, "prior").get("map"), folder)
    for k, name in enumerate(table(raw, "record").get("records") or []):
        if not (folder / str(name)).is_file():
            yield Problem(f"record.records[{k}]", f"no file {name!r}", "name a log or a table")
    yield from _modes(raw)
    yield from _mode_signals(raw, kinds)
    yield from _messages(raw, catalog)


def _averaged(raw: Raw, kinds: dict[str, str | None]) -> Iterator[Problem]:
    """A command or a mode is held from sample to sample: its mean over a window is no value."""
    written = key_of(table(raw, "source"), "average")
    held = [name for name, kind in kinds.items() if kind in ("command", "mode")]
    if written in table(raw, "source") and held:
        problem = f"the {kinds[held[0]]} {held[0]!r} is held from sample to sample"
        yield Problem(f"source.{written}", problem, "leave it out, averages are of measurements")


def _signal(
    path: str, signal: Raw, kind: str | None, catalog: Catalog | None, raw: Raw
) -> Iterator[Problem]:
    yield from _signal_source(path, signal, catalog, raw)
    is_found = kind == "command" and "state" in table(raw, "rate") and not catalog
    if signal.get("offset") == "estimate" and not is_found:
        remedy = "give a number; the neutral of a command is found in tables, beside [rate] state"
        yield Problem(f"{path}.offset", "cannot be estimated here", remedy)
    dbc_unit = find_dbc_unit(signal, catalog)
    name = signal.get("unit", dbc_unit)
    unit = find_unit(str(name)) if name else None
    names = [u.name for u in UNITS]
    if name is None:
        yield Problem(f"{path}.unit", "missing", 'add e.g. unit = "bar"')
    elif unit is None:
        yield Problem(f"{path}.unit", f"{name!r} is no known unit", nearest(str(name), names))
    elif kind is None:
        yield Problem(f"{path}.unit", f"{name!r} fits no kind of signal", "add kind or correct it")
    elif kind in KIND_DIMENSIONS and unit.dimension not in KIND_DIMENSIONS[kind]:
        fit = [u.name for d in KIND_DIMENSIONS[kind] for u in units_of(d)]
        yield Problem(f"{path}.unit", f"{name!r} is no unit of {kind}", f"use {' or '.join(fit)}")
    elif (
        unit.dimension == "angle"
        and "table" not in signal
        and kind != OTHER
        and not goes_round(raw)
    ):
        remedy = "add table = {angle = [...], position_mm = [...]}"
        yield Problem(f"{path}.table", "missing: an angle is not yet a position", remedy)
    declared = find_unit(dbc_unit or "")
    if unit and declared and unit != declared and "scale" not in signal:
        remedy = f"use {dbc_unit!r}, or add scale = 1.0 to insist"
        yield Problem(f"{path}.unit", f"{name!r}, but the DBC says {dbc_unit!r}", remedy)


def _signal_source(path: str, signal: Raw, catalog: Catalog | None, raw: Raw) -> Iterator[Problem]:
    """A signal comes from a DBC signal, a column, or is a constant."""
    if "constant" in signal:
        return
    for key in ("message", "signal") if "dbc" in table(raw, "source") else ("column",):
        if key not in signal:
            yield Problem(f"{path}.{key}", "missing", f'add {key} = "...", or constant = ...')
    message, wanted = signal.get("message"), signal.get("signal")
    if signal.get("late_rows") and "column" not in signal:
        remedy = "a message's age is offset_ms under [messages.NAME]"
        yield Problem(f"{path}.late_rows", "is of the rows of a table", remedy)
    if catalog is None or message is None:
        return
    if message not in catalog.names:
        near = nearest(str(message), list(catalog.names))
        yield Problem(f"{path}.message", f"the DBC has no message {message!r}", near)
    elif wanted is not None:
        names = [s.name for s in catalog.message(message).signals]
        if wanted not in names:
            near = nearest(str(wanted), names)
            yield Problem(f"{path}.signal", f"{message} has no signal {wanted!r}", near)


def _reference(
    path: str, name: str | None, kind: str, kinds: dict[str, str | None]
) -> Iterator[Problem]:
    fitting = [n for n, k in kinds.items() if k == kind]
    if name is None:
        return
    if name not in kinds:
        yield Problem(path, f"there is no signal {name!r}", nearest(name, fitting))
    elif kinds[name] not in (kind, None):
        remedy = nearest(name, fitting)
        yield Problem(path, f"{name!r} is no {kind} signal but a {kinds[name]}", remedy)


def _named_signals(raw: Raw, kinds: dict[str, str | None]) -> Iterator[Problem]:
    for (section, key), kind in REFERENCES.items():
        for name, entry in tables(raw, section).items():
            yield from _reference(f"{section}.{name}.{key}", entry.get(key), kind, kinds)
    command = table(raw, "edge_defaults").get("command")
    yield from _reference("edge_defaults.command", command, "command", kinds)


def _controller(raw: Raw, kinds: dict[str, str | None]) -> Iterator[Problem]:
    named = table(raw, "controller").get("reference")
    if isinstance(named, str):
        yield from _reference("controller.reference", named, "position", kinds)


def _position(raw: Raw, kinds: dict[str, str | None]) -> Iterator[Problem]:
    named = table(raw, "geometry").get("position")
    positions = [name for name, kind in kinds.items() if kind == "position"]
    if named is not None:
        yield from _reference("geometry.position", named, "position", kinds)
    elif not positions:
        yield Problem("signals", "no position signal", 'add one with unit = "mm"')
    elif len(positions) > 1:
        remedy = f"add position = {positions[0]!r}"
        yield Problem("geometry.position", f"several positions: {', '.join(positions)}", remedy)


def goes_round(raw: Raw) -> bool:
    """True for a motor: all of its chambers have a displacement, and its position is an angle."""
    chambers = tables(raw, "chambers").values()
    return bool(chambers) and all(key_of(c, "displacement") in c for c in chambers)


def _stroke(raw: Raw) -> Iterator[Problem]:
    """A cylinder has a stroke, a motor has none; a machine is one of both."""
    geometry, chambers = table(raw, "geometry"), tables(raw, "chambers")
    written = key_of(geometry, "stroke")
    has_stroke = written in geometry
    if "geometry" in raw and not has_stroke and not goes_round(raw):
        yield Problem("geometry.stroke_mm", "missing", "add stroke_mm = 500")
    for name, chamber in chambers.items():
        written = key_of(chamber, "displacement")
        if written in chamber and (has_stroke or not goes_round(raw)):
            remedy = "a motor that goes round for ever has one in each chamber, and no stroke"
            yield Problem(f"chambers.{name}.{written}", "has no place here", remedy)


def _rate(raw: Raw, kinds: dict[str, str | None]) -> Iterator[Problem]:
    """The state of [rate], and what its maps are over."""
    rate = table(raw, "rate")
    named: dict[str, str | None] = {f"rate.{k}": rate.get(k) for k in ("state", "measured")}
    if ("state" in rate) == ("measured" in rate):
        problem = "given twice" if "state" in rate else "missing"
        remedy = 'state = "x" where the maps give the rate of x, measured = "y" where y itself'
        yield Problem("rate.state", problem, remedy)
    ports = rate.get("ports", {})
    for name in ports if isinstance(ports, dict) else ():
        yield from _reference(f"rate.ports.{name}", name, "pressure", kinds)
    for name, part in tables(raw, "maps").items():
        yield from _map_commands(f"maps.{name}", part, raw, kinds)
        named[f"maps.{name}.over"] = part.get("over")
        if ("over" in part) != ("over_grid" in part):
            remedy = "give both, or neither for a map over its command alone"
            yield Problem(f"maps.{name}.over", "over and over_grid belong together", remedy)
    for path, wanted in named.items():
        if wanted is not None and wanted not in kinds:
            yield Problem(path, f"there is no signal {wanted!r}", nearest(wanted, list(kinds)))


def _map_commands(
    path: str, part: Raw, raw: Raw, kinds: dict[str, str | None]
) -> Iterator[Problem]:
    """The one command of a map, or those that share it, and the unit of each."""
    several = part.get("commands", [])
    if ("command" in part) == bool(several):
        problem = "given twice" if several else "missing"
        remedy = 'write command = "u", or commands = ["u1", "u2"] where several share the map'
        yield Problem(f"{path}.command", problem, remedy)
    named = several if isinstance(several, list) else []
    written = key_of(part, "u_grid")
    if (written in part) == ("grid" in part):
        problem = "given twice" if "grid" in part else "missing"
        remedy = "add u_grid_v = [-10.0, 0.0, 10.0], or grid in the unit of what is no command"
        yield Problem(f"{path}.u_grid", problem, remedy)
    places = {f"{path}.commands[{k}]": str(name) for k, name in enumerate(named)}
    if isinstance(part.get("command"), str):
        places[f"{path}.command"] = str(part["command"])
    for place, name in places.items():
        kind = kinds.get(name) if "grid" in part else None
        yield from _reference(place, name, kind or "command", kinds)
    for k, name in enumerate(named):
        if name in named[:k]:
            yield Problem(f"{path}.commands[{k}]", f"{name!r} is there twice", "name it once")
        if f"{path}_{name}".removeprefix("maps.") in tables(raw, "maps"):
            problem = f"its part of this map is called like another map, {path}_{name}"
            yield Problem(f"{path}.commands[{k}]", problem, "rename that one")
    for name in [*named, part.get("command")]:
        signal = tables(raw, "signals").get(str(name))
        unit = find_unit(str(signal.get("unit"))) if signal else None
        if isinstance(name, str) and unit is not None:
            yield from _command_unit(path, part, name, unit.dimension)


def _chamber(path: str, chamber: Raw) -> Iterator[Problem]:
    stems = "area", "piston_diameter", "displacement"
    given = [key for key in (key_of(chamber, stem) for stem in stems) if key in chamber]
    if len(given) != 1:
        remedy = "give either area_cm2 or piston_diameter_mm (and rod_diameter_mm); of a motor "
        remedy += "that goes round for ever displacement_cm3, per turn"
        said = "given twice" if given else "missing"
        yield Problem(f"{path}.{given[0] if given else 'area'}", said, remedy)


def _edge(
    path: str,
    edge: Raw,
    raw: Raw,
    kinds: dict[str, str | None],
    catalog: Catalog | None,
    folder: Path,
) -> Iterator[Problem]:
    inherited = table(raw, "edge_defaults").items()
    merged = edge | {key: value for key, value in inherited if key not in edge}  # own keys first
    for stem, example in EDGE_NEEDS.items():
        if key_of(merged, stem) == stem:
            yield Problem(f"{path}.{stem}", "missing", f"add {example} here or in [edge_defaults]")
    commands = [name for name, kind in kinds.items() if kind == "command"]
    command = merged.get("command", commands[0] if len(commands) == 1 else None)
    if command is None:
        remedy = f"add command = {commands[0]!r}" if commands else 'add a signal in "V" or "A"'
        yield Problem(f"{path}.command", "missing", remedy)
    elif command in kinds:
        signal = tables(raw, "signals")[command]
        unit = find_unit(str(signal.get("unit") or find_dbc_unit(signal, catalog) or ""))
        yield from _command_unit(path, merged, command, unit.dimension if unit else "")
    if edge.get("source") is not None and edge.get("source") == edge.get("sink"):
        yield Problem(f"{path}.sink", "is the same signal as source", "name the other side")
    pressures = {chamber.get("pressure") for chamber in tables(raw, "chambers").values()}
    if (
        pressures
        and pressures <= set(kinds)
        and not {edge.get("source"), edge.get("sink")} & pressures
    ):
        known = ", ".join(sorted(str(p) for p in pressures))
        yield Problem(path, "touches no chamber", f"source or sink must be one of: {known}")
    file = edge.get("reference_map")
    if isinstance(file, str) and not (folder / file).is_file():
        yield Problem(f"{path}.reference_map", f"no file {file!r}", "give an existing CSV file")


def _command_unit(path: str, edge: Raw, command: str, dimension: str) -> Iterator[Problem]:
    """The command grid must be in the unit of the command."""
    fitting = [unit.key for unit in units_of(dimension)] if dimension else []
    for stem in ("u_grid", "safe_band"):
        key = key_of(edge, stem)
        suffix = key.rpartition("_")[2]
        known = suffix in [unit.key for unit in units_of("command")]
        if key != stem and known and fitting and suffix not in fitting:
            remedy = "write " + " or ".join(f"{stem}_{k}" for k in fitting)
            yield Problem(f"{path}.{key}", f"does not fit the {dimension} {command!r}", remedy)


def _prior(named: str | None, folder: Path) -> Iterator[Problem]:
    if isinstance(named, str) and not (folder / named).exists():
        remedy = "name a map of `rtid export`, a data sheet, or a folder of `rtid fleet`"
        yield Problem("prior.map", f"no file {named!r}", remedy)


def _modes(raw: Raw) -> Iterator[Problem]:
    edges = list(tables(raw, "edges"))
    for mode, names in table(raw, "modes").items():
        if not isinstance(names, list):
            yield Problem(f"modes.{mode}", "must be a list of edges", f"write {mode} = {edges[:2]}")
            continue
        for k, name in enumerate(names):
            if name not in edges:
                near = nearest(str(name), edges)
                yield Problem(f"modes.{mode}[{k}]", f"there is no edge {name!r}", near)


def _mode_signals(raw: Raw, kinds: dict[str, str | None]) -> Iterator[Problem]:
    """A mode signal names the number of every mode, and every edge is in one."""
    signals = [name for name, kind in kinds.items() if kind == "mode"]
    for name in signals[1:]:
        yield Problem(f"signals.{name}", "a second signal of the mode", f"keep {signals[0]}")
    if not signals:
        return
    path, modes = f"signals.{signals[0]}.numbers", table(raw, "modes")
    numbers = tables(raw, "signals")[signals[0]].get("numbers")
    if not isinstance(numbers, dict) or set(numbers) != set(modes):
        example = ", ".join(f"{mode} = {k}" for k, mode in enumerate(modes or ["extend"], 1))
        yield Problem(path, "must give the number of each of [modes]", f"numbers = {{{example}}}")
    listed = {name for names in modes.values() if isinstance(names, list) for name in names}
    for edge in sorted(set(tables(raw, "edges")) - listed):
        yield Problem(f"edges.{edge}", "is open in no mode", "name it in one of [modes]")


def _messages(raw: Raw, catalog: Catalog | None) -> Iterator[Problem]:
    messages = tables(raw, "messages")
    if catalog is None:
        return
    for name, message in messages.items():
        if name not in catalog.names:
            near = nearest(name, list(catalog.names))
            yield Problem(f"messages.{name}", f"the DBC has no message {name!r}", near)
            continue
        signals = [s.name for s in catalog.message(name).signals]
        for key in ("counter", "crc"):
            if key in message and message[key] not in signals:
                problem = f"{name} has no signal {message[key]!r}"
                yield Problem(f"messages.{name}.{key}", problem, nearest(message[key], signals))
    used = {signal.get("message") for signal in tables(raw, "signals").values()}
    for name in sorted(str(m) for m in used if m in catalog.names):
        period = key_of(messages.get(name, {}), "period")
        if period == "period" and not catalog.message_source(name).period_s:
            problem = "missing, and the DBC gives no cycle time"
            yield Problem(f"messages.{name}.period", problem, "add period_ms = 10")
