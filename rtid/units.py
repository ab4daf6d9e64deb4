"""Units at the edge: SI value = factor * value.  Inside rtid everything is SI.

A command keeps the unit that the valve amplifier speaks (V, A or % of PWM): nothing is lost by it,
because a flow map is a table over the command, whatever its unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from difflib import get_close_matches

LPM, MPA, KPA = 6e4, 1e-6, 1e-3  # of all that is shown: L/min per m3/s, MPa and kPa per Pa
# of sizes of effects, by SI unit: what the workshop says, and factor
PRACTICAL = {
    "m3/s/Pa": ("L/min/MPa", 6e10),
    "m3/s/sqrt(Pa)": ("L/min/sqrt(MPa)", 6e7),
    "m3/s": ("L/min", LPM),
    "m3/Pa": ("cm3/MPa", 1e12),
    "Pa s/m3": ("MPa/(L/min)", MPA / LPM),
    "Pa/m3": ("MPa/L", 1e-3 * MPA),
    "m3": ("L", 1e3),
    "Pa": ("MPa", MPA),
    "m": ("mm", 1e3),
    "s": ("ms", 1e3),
}
COMMAND_DIMENSIONS = ("voltage", "current", "duty")


@dataclass(frozen=True)
class Unit:
    """One unit: `name` as people write it, `key` as the suffix of a key in the project file."""

    name: str
    key: str
    dimension: str
    factor: float


UNITS = (
    Unit("m", "m", "length", 1.0),
    Unit("cm", "cm", "length", 1e-2),
    Unit("mm", "mm", "length", 1e-3),
    Unit("um", "um", "length", 1e-6),
    Unit("in", "in", "length", 0.0254),
    Unit("m2", "m2", "area", 1.0),
    Unit("cm2", "cm2", "area", 1e-4),
    Unit("mm2", "mm2", "area", 1e-6),
    Unit("m3", "m3", "volume", 1.0),
    Unit("L", "l", "volume", 1e-3),
    Unit("cm3", "cm3", "volume", 1e-6),
    Unit("Pa", "pa", "pressure", 1.0),
    Unit("kPa", "kpa", "pressure", 1e3),
    Unit("bar", "bar", "pressure", 1e5),
    Unit("MPa", "mpa", "pressure", 1e6),
    Unit("psi", "psi", "pressure", 6894.757293168),
    Unit("m/s", "mps", "velocity", 1.0),
    Unit("mm/s", "mmps", "velocity", 1e-3),
    Unit("rad", "rad", "angle", 1.0),
    Unit("deg", "deg", "angle", math.pi / 180),
    Unit("V", "v", "voltage", 1.0),
    Unit("mV", "mv", "voltage", 1e-3),
    Unit("A", "a", "current", 1.0),
    Unit("mA", "ma", "current", 1e-3),
    Unit("%", "pct", "duty", 1.0),
    Unit("PWM", "pwm", "duty", 1.0),
    Unit("s", "s", "time", 1.0),
    Unit("ms", "ms", "time", 1e-3),
    Unit("us", "us", "time", 1e-6),
    Unit("Hz", "hz", "frequency", 1.0),
    Unit("m3/s", "m3s", "flow", 1.0),
    Unit("mode", "mode", "mode", 1.0),  # the number of a working mode
    Unit("L/min", "lpm", "flow", 1e-3 / 60),
)
_BY_NAME = {unit.name: unit for unit in UNITS}
_BY_FOLDED_NAME = {unit.name.casefold(): unit for unit in reversed(UNITS)}
_ALIASES = {
    "l/min": "L/min",
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "volt": "V",
    "percent": "%",
    "µm": "um",
    "pascal": "Pa",
    "metre": "m",
    "meter": "m",
    "sec": "s",
}


def find_unit(name: str) -> Unit | None:
    """The unit called `name`, exact spelling first ("mA" is not "MA"); None if there is none."""
    name = name.strip()
    folded = name.casefold()
    alias = _BY_NAME.get(_ALIASES.get(folded, ""))
    return _BY_NAME.get(name) or alias or _BY_FOLDED_NAME.get(folded)


def units_of(dimension: str) -> tuple[Unit, ...]:
    """All units of a dimension; "command" stands for voltage, current and duty together."""
    dimensions = COMMAND_DIMENSIONS if dimension == "command" else (dimension,)
    return tuple(unit for unit in UNITS if unit.dimension in dimensions)


def nearest(name: str, choices: list[str]) -> str:
    """Words that point from a wrong name to the right one: "did you mean ...?" or the list."""
    folded = {choice.casefold(): choice for choice in choices}
    close = get_close_matches(name.casefold(), list(folded), n=1, cutoff=0.6)
    if close:
        return f"did you mean {folded[close[0]]!r}?"
    shown = ", ".join(sorted(choices)[:12]) + (", ..." if len(choices) > 12 else "")
    return f"choose one of: {shown}" if choices else "there is none yet"
