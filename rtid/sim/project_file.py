"""The project file of a simulated machine, as its honest user would have written it.

It serves the controller's frames (rtid's own DBC) and the table that `rtid.sim.run_files` writes.
"""

from __future__ import annotations

from typing import Any

import tomlkit

from rtid.model import Edge, Machine
from rtid.sim.frames import CONTROLLER_ROUTES, VALVE_ROUTES, messages_of
from rtid.units import LPM

ROUTES = CONTROLLER_ROUTES | VALVE_ROUTES
HEAD = "Written by `rtid simulate`: what the user of this simulated machine would declare.\n"


def project_text(model: Machine, stroke_m: float, name: str) -> str:
    """TOML text of the project; `model` as from `declared_model`."""
    document = tomlkit.document()
    for line in HEAD.splitlines():
        document.add(tomlkit.comment(line))
    for section, content in _sections(model, stroke_m, name).items():
        document.add(section, tomlkit.item(content))
    return tomlkit.dumps(document)


def _sections(model: Machine, stroke_m: float, name: str) -> dict[str, Any]:
    low_pa, high_pa = model.beta_bounds_pa
    routes = {signal.name: ROUTES[signal.name] for signal in model.signals}
    lag = {"nominal_ms": model.lag.nominal_s * 1e3, "tolerance_ms": model.lag.tolerance_s * 1e3}
    return {
        "project": {"name": name},
        "source": {
            "dbc": "builtin:controller.dbc",
            "mode": "cycle",
            "time_column": "t",
            "time_unit": "s",
        },
        "messages": {message: {"period_ms": 1.0} for message in messages_of(routes)},
        "signals": _signals(model),
        "geometry": {"stroke_mm": stroke_m * 1e3, "position": model.position},
        "chambers": _chambers(model, stroke_m),
        "edges": {edge.name: _edge(edge) for edge in model.edges},
        **_modes(model),
        "beta": {
            "nominal_mpa": model.beta_nominal_pa * 1e-6,
            "bounds_mpa": [low_pa * 1e-6, high_pa * 1e-6],
        },
        "dynamics": {"spool_lag": lag},
        "estimator": {"form": model.form},
    }


def _signals(model: Machine) -> dict[str, Any]:
    sections = {}
    for signal in model.signals:
        route = ROUTES[signal.name]
        sections[signal.name] = {
            "message": route.message,
            "signal": route.signal,
            "column": signal.name,
            "unit": signal.unit,
            "noise": signal.noise,
            "range": [signal.minimum, signal.maximum],
        } | ({"hold": "zero"} if route.held else {})
    return sections


def _chambers(model: Machine, stroke_m: float) -> dict[str, Any]:
    sections = {}
    for chamber in model.chambers:
        swept_m3 = chamber.area_m2 * stroke_m if chamber.sign < 0 else 0.0
        sections[chamber.name] = {
            "pressure": chamber.pressure,
            "area_cm2": chamber.area_m2 * 1e4,
            "sign": chamber.sign,
            "dead_volume_l": (chamber.v0_m3 - swept_m3) * 1e3,
        }
    return sections


def _edge(edge: Edge) -> dict[str, Any]:
    return {
        "source": edge.source,
        "sink": edge.sink,
        "command": edge.command,
        "direction": edge.direction,
        "u_grid_v": edge.grid.u_v.tolist(),
        "dp_grid_mpa": (edge.grid.dp_pa * 1e-6).round(9).tolist(),
        "safe_band_v": edge.safe_band_v,
        "rated_flow_lpm": edge.rated_q_m3s * LPM,
        "rated_dp_mpa": edge.rated_dp_pa * 1e-6,
    }


def _modes(model: Machine) -> dict[str, Any]:
    """What one command opens in either direction; nothing where each valve has its own."""
    if len({edge.command for edge in model.edges}) > 1:
        return {}
    ways = (("extend", 1), ("retract", -1))
    return {"modes": {m: [e.name for e in model.edges if e.direction == way] for m, way in ways}}
