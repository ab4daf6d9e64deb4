"""Text of a new project file: what is known is filled in, what only the user knows is a TODO."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator

from rtid.project.guess import ROLES, RoleCandidate
from rtid.units import find_unit

EDGES = {
    "pa": ("p_supply", "p_a", 1),
    "at": ("p_a", "p_tank", -1),
    "pb": ("p_supply", "p_b", -1),
    "bt": ("p_b", "p_tank", 1),
}
HINTS = {
    "p_supply": "supply pressure; constant = 70 if nobody measures it",
    "p_tank": "tank pressure; constant = 1 if nobody measures it",
    "p_a": "pressure of the chamber that grows with x",
    "p_b": "pressure of the other chamber",
    "x": "position, or a joint angle with a table",
    "u": "valve command, one signed or one per valve",
}
OTHER_UNITS = {"p": "bar", "x": "mm", "u": "V", "v": "m/s"}
# a flow bends more along the command: with 20 steps a healthy machine leaves 1.4 times its noise
U_STEPS = 40
NICE = (1.0, 2.0, 2.5, 5.0, 10.0)


def project_text(
    name: str, source: dict[str, str], roles: dict[str, RoleCandidate], rest: list[RoleCandidate]
) -> str:
    """TOML of a project; `source` holds the keys of [source], `rest` the signals without role."""
    lines = [
        "# Written by `rtid init`.  Fill in what is marked TODO, then: rtid check THIS_FILE TRACE",
        "# Every key of a quantity ends in its unit: area_cm2, area_mm2, dead_volume_l, ...",
        "",
        "[project]",
        f"name = {json.dumps(name)}",
        "",
        "[source]",
        *(f"{key} = {json.dumps(value)}" for key, value in source.items()),
        *_signals(roles, rest),
        *_geometry(),
        *_edges(roles),
        *_priors(),
    ]
    return "\n".join(lines) + "\n"


def _signals(roles: dict[str, RoleCandidate], rest: list[RoleCandidate]) -> Iterator[str]:
    for role in ROLES:
        candidate = roles.get(role.name)
        if candidate is not None:
            yield from _signal(role.name, candidate)
        elif role.name != "v":  # a velocity is welcome, not needed
            unit = OTHER_UNITS[role.name[0]]
            yield from (
                "",
                f"[signals.{role.name}]  # TODO: {HINTS[role.name]}",
                f'unit = "{unit}"',
            )
    if rest:
        names = ", ".join(c.full_name for c in rest)
        yield from ("", f"# Not used: {names}")


def _signal(role: str, candidate: RoleCandidate) -> Iterator[str]:
    yield from ("", f"[signals.{role}]")
    if candidate.message:
        yield from (
            f"message = {json.dumps(candidate.message)}",
            f"signal = {json.dumps(candidate.name)}",
        )
    else:
        yield f"column = {json.dumps(candidate.name)}"
    doubt = "  # TODO: guessed from its range, confirm" if candidate.guessed_unit else ""
    yield f"unit = {json.dumps(candidate.unit)}{doubt}"
    unit = find_unit(candidate.unit)
    if unit is not None and unit.dimension == "angle":
        yield "# TODO: table = {angle = [-30, 0, 45], position_mm = [0, 210, 500]}"
    if role != "u":
        yield 'noise = "estimate"'


def _geometry() -> Iterator[str]:
    yield from (
        "",
        "[geometry]",
        "# stroke_mm = 500  # TODO",
        "",
        "[chambers.a]",
        'pressure = "p_a"',
        "sign = 1  # the volume grows with x",
        "# area_cm2 = 19.6  # TODO, or piston_diameter_mm = 50",
        "# dead_volume_l = 0.6  # TODO: volume left at the end where it is smallest, with hoses",
        "",
        "[chambers.b]",
        'pressure = "p_b"',
        "sign = -1  # the volume shrinks with x",
        "# area_cm2 = 9.46  # TODO, or piston_diameter_mm = 50 and rod_diameter_mm = 36",
        "# dead_volume_l = 0.6  # TODO",
    )


def _edges(roles: dict[str, RoleCandidate]) -> Iterator[str]:
    u, p = roles.get("u"), roles.get("p_supply") or roles.get("p_a")
    unit = (find_unit(u.unit) if u else None) or find_unit("V")
    pressure = (find_unit(p.unit) if p else None) or find_unit("bar")
    assert unit is not None and pressure is not None
    u_max = nice(max(abs(u.low), abs(u.high)) if u else 0.0, 10.0)
    p_max_mpa = nice(max(pressure.si(p.high), 0.0) * 1e-6 if p else 0.0, 10.0)
    yield from (
        "",
        "[edge_defaults]  # borders of the blocks of each flow map; the spacing may be unequal",
        'command = "u"',
        f"u_grid_{unit.key} = [{{start = 0.0, stop = {u_max:g}, step = {u_max / U_STEPS:g}}}]",
        f"dp_grid_mpa = [{{start = 0.0, stop = {p_max_mpa:g}, step = {p_max_mpa / 20:g}}}]",
        f"safe_band_{unit.key} = 0  # TODO if known: shut for sure up to {u_max / 10:g} or so",
        "# rated_flow_lpm = 30  # TODO: data sheet, flow at rated_dp, fully open",
        "rated_dp_mpa = 0.5",
    )
    for name, (source, sink, direction) in EDGES.items():
        yield from ("", f"[edges.{name}]", f'source = "{source}"', f'sink = "{sink}"')
        yield f"direction = {direction}  # opens with u {'>' if direction > 0 else '<'} 0"


def _priors() -> Iterator[str]:
    yield from (
        "",
        "[beta]  # effective bulk modulus: first guess and what is possible",
        "nominal_mpa = 800",
        "bounds_mpa = [200, 1600]",
        "",
        "[dynamics.spool_lag]  # data sheet",
        "nominal_ms = 0",
        "tolerance_ms = 5",
    )


def nice(size: float, otherwise: float) -> float:
    """The next round number from `size` on."""
    if not (math.isfinite(size) and size > 0):
        return otherwise
    decade = 10.0 ** math.floor(math.log10(size))
    return next(decade * step for step in NICE if decade * step >= 0.999 * size)
