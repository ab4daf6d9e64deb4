"""A lag behind the maps of a plant whose rate is measured: y + tau dy/dt = f(u, x).

Linear in the maps: their columns stay as they are, and the measured side gets tau dy/dt more.  The
noise n of y then stands in the equation as n + tau dn/dt, so that its rows are whitened by
1 / (1 + tau s): the maps are those of the least error of y itself.  tau is moved by what the
*modelled* y would change, -dT/dt with T the lagged flow of the map, which has no noise: that of y,
whatever its colour, does not bias it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rtid.effects.column import Cause, of_page
from rtid.effects.filtering import filtered
from rtid.effects.law import BEHIND_MAPS, Shape, Volumes
from rtid.effects.laws.timing import Psi, TimingLaw, of_law
from rtid.effects.page import Effect
from rtid.model import Machine
from rtid.plain import FloatArray

if TYPE_CHECKING:
    from rtid.effects.record_view import RecordView


def _as_it_is(values: FloatArray, _dt_s: float, _psi: Psi) -> FloatArray:
    return values


MAP_LAG = of_law(BEHIND_MAPS, _as_it_is, where="")


def map_lag_of(model: Machine) -> TimingLaw | None:
    """The lag behind the maps of a plant whose rate is measured; None for all others."""
    return replace(MAP_LAG, where=model.measured) if model.measured else None


def behind_s(timings: tuple[tuple[TimingLaw, Psi], ...]) -> float:
    """Time constant behind the maps among these timings, 0 without one."""
    return sum(psi[0] for timing, psi in timings if timing.effect == MAP_LAG.effect)


def with_lag(model: Machine, lag_s: float, step_s: float) -> Machine:
    """The machine with a lag behind its maps; its integral is as uncertain as y makes it there.

    step_s: usual step of its samples.
    """
    chambers = tuple(replace(chamber, behind_s=lag_s) for chamber in model.chambers)
    known = model.signals[model.column(model.position)].noise
    noise = float(np.hypot(known, np.sqrt(softness(model, lag_s, step_s))))
    return replace(model, chambers=chambers).with_noise({model.position: noise})


def softness(model: Machine, lag_s: float, step_s: float) -> float:
    """White variance of the equation behind a lag, by the noise of y, at steps of a record."""
    return float((lag_s * model.chambers[0].disturbance) ** 2 / step_s)


def map_lag(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """What a lag would change of the flows, for lags of the page."""
    if view.model.measured:
        page = of_page(effect, view.model.measured, shape=("time_constant",), called="share")

        def change(shape: Shape) -> Volumes:
            flow = view.chamber_flow(0)
            states = _states(flow, view.step_s, shape[0])
            return {0: (0.5 * (states[1:] + states[:-1]) - flow) * view.dt_s}

        yield Cause(page, change, (effect.parameters[0].start,))


def later(view: RecordView, lag_s: float) -> Volumes:
    """Volumes per interval of a unit more of the lag: -dT/dt, T the lagged flow of the map."""
    return {0: -np.diff(_states(view.chamber_flow(0), view.step_s, lag_s))}


def _states(flow: FloatArray, step_s: float, lag_s: float) -> FloatArray:
    """What follows a flow (n - 1,) that is held over its intervals, at the samples (n,)."""
    if lag_s <= 0.0 or not len(flow):
        return np.concatenate([flow[:1], flow])
    fade = float(np.exp(-step_s / lag_s))
    states = filtered((0.0, 1.0 - fade, 0.0), (1.0, -fade, 0.0), np.append(flow, 0.0) - flow[0])
    return states + flow[0]


def left_behind(rates: FloatArray, step_s: float, lag_s: float) -> FloatArray:
    """What an error of the equation, rates (n - 1, chambers), makes of y: through the lag.

    Unknown ones, NaN, stay unknown and count as none for what follows.
    """
    if lag_s <= 0.0:
        return rates
    fade = float(np.exp(-step_s / lag_s))
    known = np.nan_to_num(rates)
    taps = (1.0 - fade, 0.0, 0.0), (1.0, -fade, 0.0)
    passed = [filtered(*taps, column) for column in known.T]
    return np.where(np.isnan(rates), np.nan, np.stack(passed, axis=1))
