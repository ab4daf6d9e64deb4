"""The numbers of what is part of a fit, by name: in SI, with their deviations."""

from __future__ import annotations

import numpy as np

from rtid.diagnose.fit import Fit
from rtid.diagnose.report import OVER, Value
from rtid.diagnose.trials import physical
from rtid.effects.column import Candidate
from rtid.effects.law import LENGTH, fitted_names
from rtid.effects.laws.lines import LINE, inertance
from rtid.plain import Key


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
            value, sd = fit.held.value(column), fit.sd_of(column)
            scale = physical(fit, effect, 1.0)
            if not effect.is_whole:
                values[effect.parameter] = Value(scale * value, abs(scale) * sd, here(effect.unit))
            free = fit.shape_columns(effect)
            for k, name in enumerate(effect.shape_names):
                sd = fit.sd_of(free[k]) / abs(value) if k in free else float("nan")
                values[name] = Value(effect.shape[k], sd, here(effect.shape_units[k]))
            if effect.law.law == LINE:
                values |= _inertance(fit, effect, values)
            values |= over(fit, effect)
    return values


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
