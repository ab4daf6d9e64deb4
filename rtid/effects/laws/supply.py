"""A supply that gives way to what is drawn: two limits of the finite pump of `pump`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rtid.effects.column import Cause, of_page
from rtid.effects.law import Shape, Volumes
from rtid.effects.laws.common import supply_change
from rtid.effects.laws.pump import demand, drawn_down, usual_demand
from rtid.effects.page import Effect
from rtid.effects.record_view import RecordView

SAG_TIMES_S = (0.05, 0.15, 0.4, 1.2)
PUMP_FLOWS = (0.3, 0.5, 0.7, 0.85, 0.95)  # quantiles of the demand that a pump may deliver
NO_DROOP = 1e-9  # resistance, Pa s/m3: nothing beside what is missing at the limit


def supply(view: RecordView, effect: Effect) -> Iterator[Cause]:
    """A droop behind a lag, from a pump that never reaches its limit; and one that only sags there.

    Offered where the supply is no measurement: a measured one has its sag in dp.
    """
    if not view.supply_name:
        return
    drawn = demand(view)
    flows = usual_demand(view)
    flows = flows[flows > 0]
    is_open = len(flows) > 0 and not view.supply_is_measured

    def droop(shape: Shape) -> Volumes:
        (tau_s,) = shape
        return supply_change(
            view, -drawn_down(drawn, view.step_s, (1.0, np.inf, 1.0 / max(tau_s, 1e-9)))
        )

    def limit(shape: Shape) -> Volumes:
        (pump_flow,) = shape
        return supply_change(view, -drawn_down(drawn, view.step_s, (NO_DROOP, pump_flow, 1.0)))

    bank = tuple(float(v) for v in np.quantile(flows, PUMP_FLOWS)) if len(flows) else (0.0,)
    yield Cause(
        replace(of_page(effect, view.supply_name),
                shape_names=("time_constant",), shape_units=("s",)),  # resistance / stiffness
        droop, (SAG_TIMES_S,), offered=is_open,
    )  # fmt: skip
    yield Cause(
        of_page(effect, view.supply_name, "stiffness", ("pump_flow",)),
        limit, (bank,), offered=is_open,
    )  # fmt: skip
