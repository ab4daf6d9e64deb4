"""The project file of a machine that nobody has described, from guesses and assumptions.

In the units that people speak; what was assumed stands at its head, with what is wrong if it is not
so.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import tomlkit

from rtid.effects import correcting
from rtid.effects.page import DEAD_VOLUME
from rtid.project.guess import RoleCandidate
from rtid.project.template import EDGES, nice
from rtid.study.quick_machine import RATED_DP_PA, SUPPLY_PA, Assumption, MachineSizes, lag_of
from rtid.trace.quick_source import Source, unit_of
from rtid.units import AIR_PA, LPM, units_of

TANK_PA = 1e5
HELD = "zero"  # how a command runs to its next sample, unless it is said
DIGITS = 6  # of what is written
SLOW_MS, GAP_STEPS = 20.0, 2.5  # a table with longer steps than the usual gate lets through


def project_text(
    name: str, source: Source, roles: dict[str, RoleCandidate], machine: MachineSizes
) -> str:
    """TOML of the machine's project file, complete."""
    u = unit_of(roles["u"])
    key = next(unit.key for unit in units_of(u.dimension) if unit.factor == 1.0)
    raw: dict[str, Any] = {"project": {"name": name}, "source": dict(source.keys)}
    raw["messages"] = {
        message: {"period_ms": period, **_channel(source, message)}
        for message, period in source.periods_ms.items()
        if any(c.message == message for c in roles.values())
    }
    raw["signals"] = _signals(source, roles, machine)
    raw |= _sizes(machine)
    raw["edge_defaults"] = {
        "command": "u",
        f"u_grid_{key}": [_neat(border) for border in machine.u_grid],
        "dp_grid_mpa": [_neat(1e-6 * border) for border in machine.dp_grid_pa],
        f"safe_band_{key}": _neat(machine.safe_band or 0.0),
        "rated_flow_lpm": _neat(LPM * machine.rated_flow_m3s),
        "rated_dp_mpa": _neat(1e-6 * RATED_DP_PA),
    }
    raw["edges"] = {
        edge: {"source": start, "sink": sink, "direction": way}
        for edge, (start, sink, way) in EDGES.items()
    }
    if machine.dead_is_fitted:
        dead, *_ = correcting(DEAD_VOLUME)
        raw["added"] = [
            {"effect": dead.name, "where": chamber, "parameters": {dead.size.name: volume}}
            for chamber in "ab"
            for volume in [_extra(machine, chamber) | {"unit": dead.size.unit}]
        ]
    lag_ms, tolerance_ms = map(_neat, lag_of(machine))
    lag = {"nominal_ms": lag_ms, "tolerance_ms": tolerance_ms}
    seen = {} if machine.lag_seen_s is None else {"seen_ms": _neat(1e3 * machine.lag_seen_s)}
    raw["dynamics"] = {"spool_lag": lag | seen}
    raw["gates"] = {"max_gap_ms": GAP_STEPS * source.step_ms} if source.step_ms > SLOW_MS else {}
    if machine.spans_s:
        teaches, judges = machine.spans_s
        raw["record"] = {"identification_s": list(teaches), "validation_s": list(judges)}
    return tomlkit.dumps({name: part for name, part in raw.items() if part})


def _sizes(machine: MachineSizes) -> dict[str, Any]:
    """[geometry] and [chambers] of a cylinder, or of a motor that has no stroke."""
    bore = {"piston_diameter_mm": _neat(1e3 * machine.bore_m)}
    rod = {"rod_diameter_mm": _neat(1e3 * machine.rod_m)}
    geometry = {"stroke_mm": _neat(1e3 * machine.stroke_m)}
    if machine.goes_round:
        bore, rod, geometry = {"displacement_cm3": _neat(1e6 * machine.displacement_m3)}, {}, {}
    room_a, room_b = ({"dead_volume_l": _neat(1e3 * v)} for v in machine.dead_volumes_m3)
    return {
        "geometry": geometry,
        "chambers": {
            "a": {"pressure": "p_a", "sign": 1, **bore, **room_a},
            "b": {"pressure": "p_b", "sign": -1, **bore, **rod, **room_b},
        },
    }


def _extra(machine: MachineSizes, chamber: str) -> dict[str, float]:
    """Dead volume of a chamber beyond the assumed one: as fitted; 0: nobody knows."""
    if chamber not in machine.extra_volumes:
        return {"value": 0.0}
    value, sd = machine.extra_volumes[chamber]
    return {"value": _neat(value), "sd": _neat(sd)}


def _neat(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def head_of(assumptions: Iterable[Assumption]) -> str:
    """What a project file stands on, as its comment."""
    text = "Written by `rtid quick`.  Assumed, and what is wrong if it is not so:"
    lines = [text, *(f"* {a.what}: else {a.if_wrong}." for a in assumptions)]
    return "".join(f"# {line}\n" for line in lines) + "\n"


def _channel(source: Source, message: str) -> dict[str, int]:
    return {"channel": source.channels[message]} if message in source.channels else {}


def _signals(
    source: Source, roles: dict[str, RoleCandidate], machine: MachineSizes
) -> dict[str, dict[str, Any]]:
    sections: dict[str, dict[str, Any]] = {}
    for role, candidate in roles.items():
        if role == "v":
            continue
        on_bus = {"message": candidate.message, "signal": candidate.name}
        section: dict[str, Any] = (on_bus if candidate.message else {"column": candidate.name}) | {
            "unit": candidate.unit
        }
        if role != "u":
            section["noise"] = "estimate" if candidate.high > candidate.low else _least(candidate)
            if role in machine.noise_seen:
                section["noise_seen"] = _neat(machine.noise_seen[role] / unit_of(candidate).factor)
            if candidate.name in source.steps:
                section["resolution"] = source.steps[candidate.name]
        elif machine.command_noise or machine.command_hold != HELD:
            noise = _neat(machine.command_noise / unit_of(candidate).factor)
            section |= {"hold": machine.command_hold, "noise": noise}
        if role == "u" and machine.command_late_rows:
            section["late_rows"] = machine.command_late_rows
        if role.startswith("p_") and machine.pressures_from_air:
            section["offset"] = _neat(AIR_PA / unit_of(candidate).factor)
        turned = role in machine.reversed
        if turned:
            section["scale"] = -1.0
        if role == "x" and (turned or machine.x_zero_m):
            end_m = machine.stroke_m + machine.x_zero_m if turned else -machine.x_zero_m
            section["offset"] = end_m / unit_of(candidate).factor
        if role == "u" and machine.u_zero:
            section["offset"] = _neat(-section.get("scale", 1.0) * _neutral(candidate, machine))
        sections[role] = section
    if "p_supply" not in roles:
        sections["p_supply"] = {"unit": "Pa", "constant": machine.supply_pa or _supply_pa(roles)}
    if "p_tank" not in roles:
        sections["p_tank"] = {"unit": "Pa", "constant": TANK_PA}
    return sections


def _neutral(command: RoleCandidate, machine: MachineSizes) -> float:
    """What a command is counted from, in its unit."""
    return machine.u_zero / unit_of(command).factor


def of_neutral(command: RoleCandidate, machine: MachineSizes) -> list[Assumption]:
    """What a command is counted from that never changes its sign."""
    if not machine.u_zero:
        return []
    zero = f"{_neutral(command, machine):.4g} {command.unit}".rstrip()
    return [
        Assumption(
            f"{command.name} is counted from {zero}, in the middle of where x stands (offset)",
            "every map begins at another command, and one of each pair opens too early",
        )
    ]


def of_missing(roles: dict[str, RoleCandidate], supply_pa: float | None) -> list[Assumption]:
    """What is assumed of pressures that nobody measures; supply_pa: as it was said."""
    assumptions = []
    if "p_supply" not in roles and supply_pa is None:
        assumptions.append(Assumption(
            f"the supply is not measured, and stays at {1e-6 * _supply_pa(roles):g} MPa (--supply)",
            "maps of the supply's valves are off, and where it varies the verdict too",
        ))  # fmt: skip
    if "p_tank" not in roles:
        assumptions.append(Assumption(
            f"the tank is at {1e-6 * TANK_PA:g} MPa", "maps to the tank are off at small drops",
        ))  # fmt: skip
    return assumptions


def of_units(roles: dict[str, RoleCandidate]) -> list[Assumption]:
    """Units that no file and no name says, guessed from how far a signal goes."""
    assumptions = []
    pressures = [c for r, c in roles.items() if r.startswith("p_") and c.guessed_unit]
    if pressures:
        names = ", ".join(c.name for c in pressures)
        assumptions.append(Assumption(
            f"{names} are in {pressures[0].unit}, by their range",
            "every modulus is scaled by the true unit over this one",
        ))  # fmt: skip
    if roles["x"].guessed_unit:
        assumptions.append(Assumption(
            f"{roles['x'].name} is in {roles['x'].unit}, by its range",
            "every flow, leak and map is scaled by the true unit over this one",
        ))  # fmt: skip
    return assumptions


def of_channels(source: Source, roles: dict[str, RoleCandidate]) -> list[Assumption]:
    """Which channel is taken of a message that comes on several."""
    messages = sorted({c.message for c in roles.values()} & set(source.channels))
    return [
        Assumption(
            f"{message} comes on several channels, and channel {source.channels[message]} is meant",
            f"the other channel is another machine: name it under [messages.{message}]",
        )
        for message in messages
    ]


def _supply_pa(roles: dict[str, RoleCandidate]) -> float:
    """A supply that nobody measures: a round pressure above what the chambers reach."""
    return nice(max(unit_of(roles[r]).si(roles[r].high) for r in ("p_a", "p_b")), SUPPLY_PA)


def _least(candidate: RoleCandidate) -> float:
    """Noise of a signal that never changes, in its unit: something, for a machine to be loaded."""
    return 1e-6 * max(1.0, abs(candidate.high))
