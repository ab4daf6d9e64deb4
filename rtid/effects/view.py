"""What an effect may look at: the signals of a record in SI, with volumes and areas.

Names that an expression may use: every signal by its name in the project file, `t` (s), `x` (m),
`v` (m/s), and per chamber c `V_c` (m3) and `A_c` (m2).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rtid.effects.dimension import Dimension, dimension_of_unit
from rtid.effects.page import EffectError
from rtid.model import COMMAND, MODE, POSITION, PRESSURE, VELOCITY, Machine
from rtid.plain import FloatArray
from rtid.units import nearest

_UNIT_OF_KIND = {COMMAND: "V", PRESSURE: "Pa", POSITION: "m", VELOCITY: "m/s", MODE: "1"}


def names_of(
    kinds: Mapping[str, str | None], chambers: Iterable[str]
) -> dict[str, Dimension | None]:
    """Every name that an expression may use, with its dimension (None: any).

    kinds: kind of each signal (`rtid.model.COMMAND`, ...) by its name.
    """
    units = {"t": "s", "x": "m", "v": "m/s"}
    for chamber in chambers:
        units |= {f"V_{chamber}": "m3", f"A_{chamber}": "m2"}
    known: dict[str, Dimension | None] = {n: dimension_of_unit(u) for n, u in units.items()}
    for name, kind in kinds.items():
        unit = _UNIT_OF_KIND.get(kind or "")
        known[name] = dimension_of_unit(unit) if unit else None
    return known


def names_of_model(model: Machine) -> dict[str, Dimension | None]:
    """As `names_of`, for the signals and chambers of a model."""
    return names_of({s.name: s.kind for s in model.signals}, [c.name for c in model.chambers])


@dataclass(frozen=True)
class View:
    """One record, SI: values (n, signals) in the order of `model.signals` at the times t_s (n,).

    A command at sample k acts from t_s[k] to t_s[k + 1]; all others are taken at t_s[k].
    """

    model: Machine
    t_s: FloatArray
    values: FloatArray

    def signal(self, name: str) -> FloatArray:
        """One signal by its name, (n,), SI; EffectError if the model has none."""
        names = [s.name for s in self.model.signals]
        if name not in names:
            raise EffectError(f"there is no signal {name!r}", nearest(name, names))
        if name not in self._signals:
            self._signals[name] = np.ascontiguousarray(self.values[:, names.index(name)])
        return self._signals[name]

    @cached_property
    def _signals(self) -> dict[str, FloatArray]:
        """Those that were asked for: next to one another, they are read much faster."""
        return {}

    def _of_kind(self, kind: str) -> dict[str, FloatArray]:
        return {s.name: self.signal(s.name) for s in self.model.signals if s.kind == kind}

    @cached_property
    def before_the_next_command(self) -> View:
        """The same record at t_s[1:], with the command that acted until then."""
        values = self.values[1:].copy()
        for k, signal in enumerate(self.model.signals):
            if signal.is_held:
                values[:, k] = self.values[:-1, k]
        return View(self.model, self.t_s[1:], values)

    @cached_property
    def dt_s(self) -> FloatArray:
        """Time to the next sample, (n,); the last one repeats."""
        steps = np.diff(self.t_s)
        return np.append(steps, steps[-1:]) if len(steps) else np.zeros(len(self.t_s))

    @cached_property
    def u(self) -> FloatArray:
        """The first command, (n,), V."""
        commands = self._of_kind(COMMAND)
        if not commands:
            raise EffectError("the model has no command", "name a signal with view.signal(name)")
        return next(iter(commands.values()))

    @cached_property
    def p(self) -> dict[str, FloatArray]:
        """Pressures (n,) by the names of their signals, Pa."""
        return self._of_kind(PRESSURE)

    @property
    def x(self) -> FloatArray:
        """Position (n,), m."""
        return self.signal(self.model.position)

    @cached_property
    def v(self) -> FloatArray:
        """Velocity (n,), m/s: as measured, else central differences of the position."""
        measured = self._of_kind(VELOCITY)
        if measured:
            return next(iter(measured.values()))
        return np.gradient(self.x, self.t_s) if len(self.t_s) > 1 else np.zeros(len(self.t_s))

    @cached_property
    def volume_m3(self) -> dict[str, FloatArray]:
        """V(x) (n,) by the chamber's name."""
        return {c.name: c.volume(self.x) for c in self.model.chambers}

    @property
    def area_m2(self) -> dict[str, float]:
        """Piston areas by the chamber's name."""
        return {c.name: c.area_m2 for c in self.model.chambers}

    def value(self, name: str) -> FloatArray:
        """Array of any name that an expression may use, (n,), SI."""
        if name in (signal.name for signal in self.model.signals):
            return self.signal(name)
        known = {"t": lambda: self.t_s, "x": lambda: self.x, "v": lambda: self.v}
        if name in known:
            return known[name]()
        if name[:2] == "V_" and name[2:] in self.volume_m3:
            return self.volume_m3[name[2:]]
        areas = {f"A_{chamber}": area for chamber, area in self.area_m2.items()}
        if name not in areas:
            raise EffectError(f"the record knows no {name!r}", nearest(name, [*known, *areas]))
        return np.full(len(self.t_s), areas[name])
