"""The numbers of what is part of a fit, by name: in SI, with their deviations."""

from __future__ import annotations

from math import sqrt

import numpy as np

from rtid.diagnose.fit import Fit
from rtid.diagnose.report import OVER, Value
from rtid.diagnose.sized import physical, physical_sd
from rtid.effects.column import Candidate
from rtid.effects.law import LENGTH, chambers_by_place, fitted_names
from rtid.effects.laws.lines import LINE, inertance
from rtid.estimator.state import variance
from rtid.plain import Key

PRESSURE = "Pa"  # unit of a pressure at which something begins


def parameters(fit: Fit, key: Key) -> dict[str, Value]:
    """The parameters of a cause that is part of a fit, by name."""
    values: dict[str, Value] = {}
    here = fit.declared.unit_here
    for k, (timing, psi) in enumerate(fit.revision.timings):
        if timing.is_at(*key):
            for name, unit, value, j in zip(
                timing.parameters, timing.units, psi, fit.timing_columns(k), strict=True
            ):
                values[name] = Value(value, fit.sd_on_its_way(j), here(unit))
    for effect in fit.revision.effects:
        if effect.key == key:
            column = fit.column(effect)
            value = fit.size_of(column)
            if not effect.is_whole:
                size, sd = physical(fit, effect, value), physical_sd(fit, effect)
                values[effect.parameter] = Value(size, sd, here(effect.unit))
            free = fit.shape_columns(effect)
            for k, name in enumerate(effect.shape_names):
                sd = fit.sd_of(free[k]) / abs(value) if k in free else float("nan")
                sd = float(np.hypot(sd, _corner_pa(fit, effect, effect.shape_units[k])))
                values[name] = Value(effect.shape[k], sd, here(effect.shape_units[k]))
            if effect.law.law == LINE:
                values |= _inertance(fit, effect, values)
            values |= over(fit, effect)
    return values


def _corner_pa(fit: Fit, effect: Candidate, unit: str) -> float:
    """What the noise of a pressure hides of where a law has its corner, Pa; 0 of other numbers.

    It rounds max(0, P - P_r) over about its deviation s, and where between P_r - s and P_r + s the
    fit then puts it depends on how long the chamber stays there: uniform.  Of 11.206 MPa behind
    8 kPa 11.212 +- 0.0001 was told.
    """
    if unit != PRESSURE or not fit.model.has_pressures:
        return 0.0
    chambers = fit.model.chambers
    at = chambers_by_place(fit.model).get(effect.where, range(len(chambers)))
    return max(sqrt(variance(fit.model, chambers[c].pressure) / 3.0) for c in at)


def over(fit: Fit, effect: Candidate) -> dict[str, Value]:
    """The time over which a change is told, that of the record that has taught it."""
    if LENGTH not in fitted_names(effect.law):
        return {}
    t_s = fit.view.t_s
    return {OVER: Value(float(t_s[-1] - t_s[0]), float("nan"), "s")}


def _inertance(fit: Fit, line: Candidate, values: dict[str, Value]) -> dict[str, Value]:
    """The inertance of a line by its shape: 1 / (w^2 V_l / beta)."""
    radps, volume, _ = (values[name] for name in line.shape_names)
    size, page = inertance(fit.view, line), line.law.size
    share = float(np.hypot(2.0 * radps.std / radps.value, volume.std / volume.value))
    return {page.name: Value(size, size * share, page.unit)}
