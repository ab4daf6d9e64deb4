"""Equations of plants that empty or cool down by themselves, as the text of a plant file.

    a body that cools    dx/dt = k u - a x + c
    two in a row         dx1/dt = k u - b x1,         dx2/dt = b x1 - a x2 + c
    a vessel             dx/dt = k u - a sqrt(x)      (Torricelli)
    two in cascade       dx1/dt = k u - b sqrt(x1),   dx2/dt = b sqrt(x1) - a sqrt(x2)

Only the last state is measured.  What stands in front of it is in the unit of what it gives.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import tomlkit

from rtid.plain import FloatArray

LEVEL, TEMPERATURE, ANY = "level", "temperature", "any"
SLOWEST, FASTEST = 1.0, 0.25  # of 1 / record and of 1 / step: what a record can tell of a rate
SMOOTHED = 8  # samples over which a command acts, at least
ABOVE = 5.0  # times the highest measured: how full what nobody measures can be


@dataclass(frozen=True)
class Structure:
    """One way in which a command fills what is measured.

    rates: by state, the last of which is measured; words: what it is.
    """

    words: str
    rates: dict[str, str]
    is_vessel: bool = False

    @property
    def measured(self) -> str:
        """The state that is measured."""
        return list(self.rates)[-1]

    @property
    def symbols(self) -> set[str]:
        """All names in the equations: parameters, states, the command, functions."""
        return set(re.findall(r"\w+", " ".join(self.rates.values())))


STANDS = Structure("what is moved, and stands where it is left", {"x": "k*u + c"})
BODIES = (
    Structure("one body that loses what it is given", {"x": "k*u - a*x + c"}),
    Structure(
        "two bodies in a row, the first of which is not measured",
        {"x1": "k*u - b*x1", "x2": "b*x1 - a*x2 + c"},
    ),
)
VESSELS = (
    Structure("a vessel that empties through a hole", {"x": "k*u - a*ssqrt(x)"}, is_vessel=True),
    Structure(
        "two vessels in cascade, the upper of which is not measured",
        {"x1": "k*u - b*ssqrt(x1)", "x2": "b*ssqrt(x1) - a*ssqrt(x2)"},
        is_vessel=True,
    ),
)


@dataclass(frozen=True)
class Told:
    """What a table tells of a plant: t_s, u, y (n,); columns and units; a second record's columns.

    quantity: of what is measured; same_start: both records begin in one state; from_s: where the
    part that judges begins, if no second record does.
    """

    t_s: FloatArray
    u: FloatArray
    y: FloatArray
    time_column: str
    columns: tuple[str, str]
    units: tuple[str, str]
    quantity: str
    others: tuple[str, str] | None
    same_start: bool
    from_s: float


def plant_text(name: str, structure: Structure, record: Told) -> str:
    """The plant file of a structure, with bounds that the record gives."""
    (u, y), (u_unit, y_unit) = record.columns, record.units
    signals = {"u": {"column": u, "unit": u_unit}}
    measured: dict[str, Any] = {"value": structure.measured, "column": y, "unit": y_unit}
    validation: dict[str, Any] = {"from_s": record.from_s}
    if record.others:
        signals["u"]["validation_column"], measured["validation_column"] = record.others
        validation = {"initial": "same" if record.same_start else "estimated"}
    raw = {
        "plant": {"name": name, "time_column": record.time_column},
        "inputs": signals,
        "states": {
            state: _state(state == structure.measured, rate, structure, record)
            for state, rate in structure.rates.items()
        },
        "outputs": {"y": measured},
        "parameters": _parameters(structure, record),
        "validation": validation,
    }
    head = f"# A plant by its equations: {structure.words}; for `rtid refit`.  Written by rtid."
    return "\n".join([head, "", tomlkit.dumps(raw)])


def _state(is_measured: bool, rate: str, structure: Structure, record: Told) -> dict[str, Any]:
    low, high, first = float(record.y.min()), float(record.y.max()), float(record.y[0])
    reach = ABOVE * (high if structure.is_vessel else high - low)
    bottom = 0.0 if structure.is_vessel else low - reach
    top = max(high, 0.0) + (0.5 * reach if is_measured else reach)
    return {
        "rate": rate,
        "quantity": LEVEL if structure.is_vessel else record.quantity,
        "unit": record.units[1],
        "start": _three(min(max(first, bottom), top)),
        "low": _three(bottom),
        "high": _three(top),
    }


def _parameters(structure: Structure, record: Told) -> dict[str, dict[str, Any]]:
    """What is estimated, with its bounds: rates between what the record and its step can tell."""
    step_s, length_s = float(np.median(np.diff(record.t_s))), float(record.t_s[-1] - record.t_s[0])
    slowest, fastest = SLOWEST / length_s, FASTEST / step_s
    usual = float(np.sqrt(slowest * fastest))
    size = max(float(np.ptp(record.y)), 1e-12)
    outflow = max(float(record.y.max()), 1e-12) ** 0.5 if structure.is_vessel else 1.0
    y_unit, u_unit = record.units[1] or "1", record.units[0] or "1"
    gain = size / max(float(np.ptp(record.u)), 1e-12)
    sign = 1.0 if structure.is_vessel else _direction(record)
    low, high = sorted((sign * slowest * gain, sign * 10.0 * fastest * gain))
    root = f"sqrt({y_unit})" if structure.is_vessel else ""
    drawn = {
        "k": (sign * usual * gain, low, high, f"{y_unit}/({u_unit} s)"),
        "a": (usual * outflow, slowest * outflow, fastest * outflow, f"{root or '1'}/s"),
        "b": (usual * outflow, slowest * outflow, fastest * outflow, f"{root or '1'}/s"),
        "c": (0.0, -size * fastest, size * fastest, f"{y_unit}/s"),
    }
    return {
        name: {"start": _three(start), "low": _three(low), "high": _three(high), "unit": unit}
        for name, (start, low, high, unit) in drawn.items()
        if name in structure.symbols
    }


def _direction(record: Told) -> float:
    """1 where what is measured grows with the command, -1 where it falls."""
    late = np.convolve(record.u - record.u.mean(), np.ones(SMOOTHED) / SMOOTHED)[: len(record.u)]
    return 1.0 if float(np.dot(late, record.y - record.y.mean())) >= 0.0 else -1.0


def _three(value: float) -> float:
    return float(f"{value:.3g}")
