"""Units at the edge: SI value = factor * value + offset.  Inside rtid everything is SI.

Here is also the one parser of the names of columns and signals, `split_name`.

A command keeps the unit that the valve amplifier speaks (V, A or % of PWM): nothing is lost by it,
because a flow map is a table over the command, whatever its unit.

What a person reads is in the units of the workshop (`scale_of`), or in SI where `show_in` says so;
files and JSON are not touched by that.  ± is the 95 % interval wherever a person reads, a standard
deviation is called so by its key in files and JSON.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from contextvars import ContextVar
from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum
from unicodedata import normalize

from firmware_bridge.names import split_unit

LPM, MPA, KPA = 6e4, 1e-6, 1e-3  # of all that is shown: L/min per m3/s, MPa and kPa per Pa
Z95 = 1.96  # standard deviations in half of a 95 % interval
UNIFORM = 3.0**0.5  # half width over standard deviation, of what may lie anywhere between
CONVENTION = "± is the 95 % interval."
# by SI unit: what the workshop says, and factor
PRACTICAL = {
    "m3/s/Pa": ("L/min/MPa", 6e10),
    "m3/s/sqrt(Pa)": ("L/min/sqrt(MPa)", 6e7),
    "m3/s": ("L/min", LPM),
    "m3/Pa": ("cm3/MPa", 1e12),
    "m3/Pa/m": ("cm3/MPa/m", 1e12),
    "m/Pa/m": ("mm/MPa/m", 1e9),
    "Pa s/m3": ("MPa/(L/min)", MPA / LPM),
    "Pa/m3": ("MPa/L", 1e-3 * MPA),
    "Pa s2/m3": ("MPa s2/L", 1e-3 * MPA),
    "m3": ("L", 1e3),
    "Pa": ("MPa", MPA),
    "m": ("mm", 1e3),
    "m/s": ("mm/s", 1e3),
    "s": ("ms", 1e3),
}
COMMAND_DIMENSIONS = ("voltage", "current", "duty")


@dataclass(frozen=True)
class Unit:
    """One unit: `name` as people write it, `key` as the suffix of a key in the project file.

    offset: SI value of zero, of a gauge pressure that of the air.
    """

    name: str
    key: str
    dimension: str
    factor: float
    offset: float = 0.0

    def si(self, value: float) -> float:
        """A value in SI."""
        return self.factor * value + self.offset


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
AIR_PA = 101_325.0
# units that signals and columns come in, and no key of a project file ends in
SIGNAL_UNITS = (
    Unit("cm/s", "cmps", "velocity", 1e-2),
    Unit("mbar", "mbar", "pressure", 1e2),
    Unit("hPa", "hpa", "pressure", 1e2),
    Unit("barg", "barg", "pressure", 1e5, AIR_PA),
    Unit("psig", "psig", "pressure", 6894.757293168, AIR_PA),
    Unit("ns", "ns", "time", 1e-9),
    Unit("min", "min", "time", 60.0),
    Unit("h", "h", "time", 3600.0),
    Unit("d", "d", "time", 86_400.0),
    Unit("L/s", "lps", "flow", 1e-3),
    Unit("rpm", "rpm", "rotation", math.pi / 30),
    Unit("rad/s", "radps", "rotation", 1.0),
    Unit("deg/s", "dps", "rotation", math.pi / 180),
    Unit("N", "n", "force", 1.0),
    Unit("kN", "kn", "force", 1e3),
    Unit("m/s2", "mps2", "acceleration", 1.0),
    Unit("g", "g", "acceleration", 9.80665),
    Unit("degC", "degc", "temperature", 1.0, 273.15),
    Unit("K", "k", "temperature", 1.0),
    Unit("kg", "kg", "mass", 1.0),
    Unit("‰", "permille", "duty", 0.1),
    # of a converter: of a command as good as any, and of what is measured no unit
    Unit("counts", "counts", "duty", 1.0),
)
_KNOWN = UNITS + SIGNAL_UNITS
_BY_NAME = {unit.name: unit for unit in _KNOWN}
_BY_FOLDED_NAME = {unit.name.casefold(): unit for unit in reversed(_KNOWN)}
_BY_KEY = {unit.key: unit for unit in _KNOWN}
_ALIASES = {
    "l/min": "L/min",
    "lpm": "L/min",
    "n/mm2": "MPa",
    "n/mm²": "MPa",
    "bara": "bar",
    "bar gauge": "barg",
    "bar (g)": "barg",
    "bar g": "barg",
    "psia": "psi",
    "psi(a)": "psi",
    "psi(g)": "psig",
    "psi gauge": "psig",
    "psi g": "psig",
    "count": "counts",
    "digits": "counts",
    "digit": "counts",
    "lsb": "counts",
    "bar(g)": "barg",
    "bar(a)": "bar",
    "1/min": "rpm",
    "u/min": "rpm",
    "min-1": "rpm",
    "m/s²": "m/s2",
    "m/s^2": "m/s2",
    "°c": "degC",
    "°/s": "deg/s",
    "dps": "deg/s",
    "inch": "in",
    "pct": "%",
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "volt": "V",
    "volts": "V",
    "amps": "A",
    "percent": "%",
    "permille": "‰",
    "per mille": "‰",
    "permil": "‰",
    "promille": "‰",
    "millimeter": "mm",
    "millimetre": "mm",
    "µm": "um",
    "µs": "us",
    "\N{GREEK SMALL LETTER MU}m": "um",
    "\N{GREEK SMALL LETTER MU}s": "us",
    "pascal": "Pa",
    "metre": "m",
    "meter": "m",
    "sec": "s",
    "seconds": "s",
    "msec": "ms",
    "usec": "us",
    "days": "d",
}
NO_UNIT = {"", "-", "--", "1", "raw", "none", "n/a"}  # said, and says nothing
# of a pressure; what is said of none is taken for absolute as well
_ABSOLUTE = re.compile(r"(?<=\w)[\s_]*\(?\babs(?:\.|olute|olut|olu)?\)?$", re.IGNORECASE)
# Last words of a name that mean something else as often: p_a is a chamber, p_s a supply, p_in an
# inlet, x_min the lowest.  They count as units where a word of the stem is of their dimension.
_AMBIGUOUS = {"m", "s", "a", "v", "l", "in", "n", "g", "h", "k", "pa", "min", "mode"}
_AMBIGUOUS |= {"ms", "us", "ns", "d"}  # p_us is upstream, x_d is desired
_OF_DIMENSION = {
    "time": {"t", "time", "timestamp", "zeit"},
    "length": {"x", "y", "z", "s", "pos", "position", "stroke", "length", "displacement", "level"},
    "voltage": {"u", "uv", "voltage", "cmd", "command"},
    "current": {"i", "current"},
    "pressure": {"p", "dp", "pressure", "press"},
    "force": {"f", "force", "load"},
    "acceleration": {"a", "acc", "accel", "acceleration"},
    "temperature": {"temp", "temperature"},
    "volume": {"vol", "volume"},
}
_UPPER, _LOWER = "[A-ZÄÖÜ]", "[a-zäöüß]"
_WORD = re.compile(rf"{_UPPER}+(?={_UPPER}{_LOWER})|{_UPPER}?{_LOWER}+|{_UPPER}+|\d+")
_SPELT = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
_BARE = str.maketrans({"ł": "l", "Ł": "L", "ø": "o", "Ø": "O"})  # which are no letter and accent
_IN_CHINESE = {
    "\u65e0\u6746\u8154": "cap",
    "\u6709\u6746\u8154": "rod",
    "\u538b\u529b": "pressure",
    "\u4f9b\u6cb9": "supply",
    "\u7cfb\u7edf": "system",
    "\u6cf5": "pump",
    "\u56de\u6cb9": "return",
    "\u6cb9\u7bb1": "tank",
    "\u4f4d\u79fb": "position",
    "\u4f4d\u7f6e": "position",
    "\u884c\u7a0b": "stroke",
    "\u901f\u5ea6": "velocity",
    "\u6307\u4ee4": "command",
    "\u63a7\u5236": "command",
    "\u9600": "valve",
}


FLOW = "m3/s"  # of what the equations of a machine with pressures are in
_rates = {FLOW: FLOW}


def show_flow_as(unit: str) -> None:
    """From now on flows are shown as what they are on this plant, of this SI unit: a speed, m/s."""
    _rates[FLOW] = unit


def flow_name() -> str:
    """What a flow is shown in, whatever the system: L/min, or the unit of the plant's rate."""
    return PRACTICAL.get(_rates[FLOW], (_rates[FLOW], 1.0))[0]


def lpm() -> float:
    """Times its SI value, what is shown of a flow in `flow_name`."""
    return PRACTICAL.get(_rates[FLOW], (_rates[FLOW], 1.0))[1]


class System(StrEnum):
    """Units that a person reads: those of the workshop (MPa, L/min, mm, ms), or SI."""

    DISPLAY = "display"
    SI = "si"


_shown: ContextVar[System] = ContextVar("shown", default=System.DISPLAY)


def show_in(system: System) -> None:
    """Choose the units of all that is printed from now on; files and JSON keep theirs."""
    _shown.set(system)


@dataclass(frozen=True)
class Scale:
    """How a quantity is shown: `factor` times its SI value, in the unit `name`."""

    name: str
    factor: float

    def number(self, value: float, decimals: int) -> str:
        """A value without its unit: so many decimals, or in SI, where sizes differ, four digits."""
        if _shown.get() == System.SI:
            return f"{value:.4g}"
        return f"{self.factor * value:.{decimals}f}"

    def known(self, value: float, sd: float, decimals: int) -> str:
        """A value with its 95 % interval, without its unit; value and standard deviation in SI."""
        if _shown.get() == System.SI:
            return f"{value:.4g} ± {_digits(Z95 * sd)}"
        return f"{self.number(value, decimals)} ± {self.number(Z95 * sd, decimals)}"


def scale_of(unit: str) -> Scale:
    """The scale on which quantities of an SI unit are shown; that of "m3/s/Pa/V" is L/min/MPa/V."""
    if unit == FLOW or unit.startswith(f"{FLOW}/"):
        unit = _rates[FLOW] + unit.removeprefix(FLOW)
    if _shown.get() == System.SI:
        return Scale(unit, 1.0)
    if unit in PRACTICAL:
        return Scale(*PRACTICAL[unit])
    whole, _, per = unit.rpartition("/")
    if whole not in PRACTICAL or per == "s":  # a rate stays one per second
        return Scale(unit, 1.0)
    below = PRACTICAL.get(per, (per, 1.0))
    return Scale(f"{PRACTICAL[whole][0]}/{below[0]}", PRACTICAL[whole][1] / below[1])


def with_unit(value: float, unit: str, sd: float = math.nan) -> str:
    """A value with its 95 % interval, where sd is known, and its unit; both are given in SI.

    Long times stay in s.
    """
    scale = Scale(unit, 1.0) if unit == "s" and abs(value) >= 1.0 else scale_of(unit)
    spread = f" ± {_digits(Z95 * scale.factor * sd)}" if math.isfinite(sd) else ""
    name = "" if unit in ("", "1") else f" {scale.name}"
    return f"{scale.factor * value:.4g}{spread}{name}"


def range_of(low: float, high: float, unit: str) -> str:
    """Both ends of a range and their unit, given in SI; long times stay in s, lengths in m."""
    scale = Scale(unit, 1.0) if unit in ("m", "s") and high >= 1 else scale_of(unit)
    name = "" if unit == "1" else f" {scale.name}"
    return f"{scale.factor * low:.4g} to {scale.factor * high:.4g}{name}"


def limit(value: float, unit: str) -> str:
    """A size of which the order matters: in two digits, with its unit; given in SI."""
    scale = scale_of(unit)
    name = "" if unit == "1" else f" {scale.name}"
    return f"{_digits(scale.factor * value)}{name}"


def _digits(value: float) -> str:
    """In two digits: 120, not 1.2e+02."""
    return f"{float(f'{value:.2g}'):.4g}"


def find_unit(name: str) -> Unit | None:
    """The unit called `name`, exact spelling first ("mA" is not "MA"); None if there is none."""
    name = _ABSOLUTE.sub("", name.strip())
    folded = name.casefold()
    alias = _BY_NAME.get(_ALIASES.get(folded, ""))
    return _BY_NAME.get(name) or alias or _BY_FOLDED_NAME.get(folded)


def split_name(title: str, dimensions: Collection[str] = ()) -> tuple[str, str]:
    """Name and unit of a column or signal: "p_s [Pa]" -> p_s, Pa; x_mm -> x, mm; p_a -> p_a, "".

    A known unit comes in its usual spelling, an unknown one in brackets as it stands; one that says
    nothing ("-") is empty.  dimensions: what the column is known to be, where it is known.
    """

    def is_unit(text: str, stem: str) -> bool:
        return _suffix(text, stem, dimensions) is not None

    stem, text = split_unit(title, is_unit)
    unit = find_unit(text) or (_suffix(text, stem, dimensions) if text else None)
    return stem, unit.name if unit else said(text)


def said(text: str) -> str:
    """A unit as a file gives it, in its usual spelling; "" where it says nothing."""
    unit = find_unit(text)
    return unit.name if unit else "" if text.strip().casefold() in NO_UNIT else text.strip()


def words_of(name: str) -> set[str]:
    """Words of a name: "PSupply" -> p, supply; "Rücklauf" -> ruecklauf, as it is often spelt.

    Accents are left out, Chinese ones are in English.
    """
    composed = normalize("NFC", name)  # some systems write an umlaut as two letters
    for written, meant in _IN_CHINESE.items():
        composed = composed.replace(written, f" {meant} ")
    plain = "".join(
        letter if letter.lower() in "äöü" else normalize("NFD", letter)[0] for letter in composed
    )
    return {word.lower().translate(_SPELT) for word in _WORD.findall(plain.translate(_BARE))}


def _suffix(text: str, stem: str, dimensions: Collection[str]) -> Unit | None:
    """The unit that the end of a name stands for; None where it is not sure to be one."""
    if text.casefold() not in _AMBIGUOUS:
        return find_unit(text) or _BY_KEY.get(text.casefold())
    unit = _BY_NAME.get(text) or _BY_KEY.get(text)
    if unit is None or unit.dimension in dimensions:
        return unit
    return unit if words_of(stem) & _OF_DIMENSION.get(unit.dimension, set()) else None


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
