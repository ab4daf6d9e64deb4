"""The project file of a machine that nobody has described, from guesses and assumptions."""

from __future__ import annotations

from typing import Any

import tomlkit

from rtid.effects import correcting
from rtid.project.guess import RoleCandidate
from rtid.project.template import EDGES, nice
from rtid.study.quick_machine import LAG_MS, LAG_TOLERANCE_MS, SUPPLY_PA, Assumption, MachineSizes
from rtid.trace.quick_source import Source, unit_of
from rtid.units import units_of

DEAD_VOLUME = "dead volume"  # as the pages call the declared size
TANK_PA = 1e5
HELD_OUT = 0.25
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
    raw["geometry"] = {"stroke_m": machine.stroke_m}
    raw["chambers"] = {
        chamber: {"pressure": f"p_{chamber}", "sign": sign, "area_m2": area,
                  "dead_volume_m3": machine.dead_volume_m3}
        for chamber, sign, area in zip("ab", (1, -1), machine.areas_m2, strict=True)
    }  # fmt: skip
    raw["edge_defaults"] = {
        "command": "u",
        f"u_grid_{key}": machine.u_grid.tolist(),
        "dp_grid_pa": machine.dp_grid_pa.tolist(),
        f"safe_band_{key}": machine.safe_band,
        "rated_flow_m3s": machine.rated_flow_m3s,
        "rated_dp_pa": machine.rated_dp_pa,
    }
    raw["edges"] = {
        edge: {"source": start, "sink": sink, "direction": way}
        for edge, (start, sink, way) in EDGES.items()
    }
    if machine.dead_is_fitted:
        dead, *_ = correcting(DEAD_VOLUME)
        volume = {dead.size.name: {"value": 0.0, "unit": dead.size.unit}}
        raw["added"] = [
            {"effect": dead.name, "where": chamber, "parameters": volume} for chamber in "ab"
        ]
    raw["dynamics"] = {"spool_lag": {"nominal_ms": LAG_MS, "tolerance_ms": LAG_TOLERANCE_MS}}
    raw["gates"] = {"max_gap_ms": GAP_STEPS * source.step_ms} if source.step_ms > SLOW_MS else {}
    if machine.span_s:
        begin, end = machine.span_s
        split = end - HELD_OUT * (end - begin)
        raw["record"] = {"identification_s": [begin, split], "validation_s": [split, end]}
    return tomlkit.dumps({name: part for name, part in raw.items() if part})


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
            if candidate.name in source.steps:
                section["resolution"] = source.steps[candidate.name]
        turned = role in machine.reversed
        if turned:
            section["scale"] = -1.0
        if role == "x" and (turned or machine.x_zero_m):
            end_m = machine.stroke_m + machine.x_zero_m if turned else -machine.x_zero_m
            section["offset"] = end_m / unit_of(candidate).factor
        sections[role] = section
    if "p_supply" not in roles:
        sections["p_supply"] = {"unit": "Pa", "constant": _supply_pa(roles)}
    if "p_tank" not in roles:
        sections["p_tank"] = {"unit": "Pa", "constant": TANK_PA}
    return sections


def of_missing(roles: dict[str, RoleCandidate]) -> list[Assumption]:
    """What is assumed of pressures that nobody measures."""
    assumptions = []
    if "p_supply" not in roles:
        assumptions.append(Assumption(
            f"the supply is not measured, and stays at {_supply_pa(roles) / 1e5:.0f} bar",
            "maps of the supply's valves are off, and a supply that sags cannot be seen apart",
        ))  # fmt: skip
    if "p_tank" not in roles:
        assumptions.append(Assumption(
            f"the tank is at {TANK_PA / 1e5:.0f} bar", "maps to the tank are off at small drops",
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
