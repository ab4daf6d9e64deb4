"""What several columns are made of."""

from __future__ import annotations

import numpy as np

from rtid.effects.law import Volumes
from rtid.effects.record_view import RecordView
from rtid.plain import FloatArray


def stored(view: RecordView, c: int, what: FloatArray) -> FloatArray:
    """- V d(what) over each interval (n - 1,), V in the middle of it."""
    v = view.volume(c)
    return np.asarray(-0.5 * (v[1:] + v[:-1]) * np.diff(what))


def slope_to(view: RecordView, c: int) -> FloatArray:
    """Change of the flow into chamber c per Pa of its own pressure (n - 1,), negative."""
    chamber = view.model.chambers[c]
    toward = [
        int(edge.source == chamber.pressure) - int(edge.sink == chamber.pressure)
        for edge in view.model.edges
    ]
    return view.into_chamber(c, [k * view.slope_dp(i) for i, k in enumerate(toward)])


def supply_change(view: RecordView, change_pa: FloatArray) -> Volumes:
    """Volumes per interval and chamber of a small change of the supply's pressure (n,)."""
    mean = 0.5 * (change_pa[1:] + change_pa[:-1])
    flows = [
        view.slope_dp(i) * mean if edge.source == view.supply_name else np.zeros(view.n - 1)
        for i, edge in enumerate(view.model.edges)
    ]
    n_c = len(view.model.chambers)
    return {c: view.into_chamber(c, flows) * view.dt_s for c in range(n_c)}
