"""Where the data lie in the u-dp plane of a valve."""

from __future__ import annotations

import numpy as np

from rtid.estimator.track import pressure_drop
from rtid.model import Edge, Machine
from rtid.plain import FloatArray
from rtid.tell.axes import second


def working_points(model: Machine, edge: Edge, chunk: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Opening command, V, and pressure drop, Pa, (m,) of the samples with the edge open.

    chunk (n, 2 + signals), SI.
    """
    w_v = edge.direction * chunk[:, 2 + model.column(edge.command)]
    dp_pa = pressure_drop(model, edge, chunk[:, 2:])
    is_open = w_v > max(edge.safe_band_v, float(edge.grid.u_v[0]))
    return w_v[is_open], dp_pa[is_open]


def spread_points(model: Machine, edge: Edge, chunk: FloatArray, most: int) -> FloatArray:
    """Some of them, spread over the record: (n, 2), V and MPa, or as a rate's map has them."""
    w_v, dp_pa = working_points(model, edge, chunk)
    step = max(1, len(w_v) // most)
    return np.stack([w_v[::step], dp_pa[::step] * second(model.axes(edge)).factor], axis=1)
