"""Slopes dQ/ddp of maps that work within the noise of dp: the valves' own, not the flattened ones.

The rows are weighed for the noise n of dp (variance s^2) by the slope of the map.  Where dp goes
over an interval with the variance S, least squares flattens a slope a to a S / (S + s^2): where dp
stands at a few deviations of its noise, as on the supply side of a compensated valve, that is told
as 3 to 10 times less noise than there is.  So dp is smoothed for a first look at such maps, each
sample over the longest window whose parabola is within the noise of all shorter ones (Goldenshluger
and Nemirovski, Math. Methods of Statistics 6 (1997) 135): steps stay steep, and what is slow loses
nearly all of its noise.  The rows themselves stay as they were measured.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.effects.filtering import fitted, noise_left
from rtid.estimator.record import refined, summed
from rtid.estimator.solution import sketch
from rtid.estimator.state import Weights, variance
from rtid.estimator.track import pressure_drop
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray

FLATTENED = 0.01  # of a slope, by the noise of dp in an interval that it goes all over
HALVES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # samples on either side
AGREES = 1.5  # standard deviations on either side, within which a window agrees with another


def with_own_slopes(model: Machine, chunk: FloatArray, weights: Weights) -> Weights:
    """The weights with the valves' slopes where maps work within the noise of dp.

    chunk (n, 2 + signals), SI.
    """
    narrow = _narrow(model)
    if not (model.has_pressures and _works_there(model, chunk, narrow)):
        return weights
    calm = _without_noise(model, chunk)
    own = refined(model, sketch(model, summed(model, calm, weights)), weights.lag_s).slopes
    return replace(weights, slopes=np.where(np.concatenate(narrow, axis=None), own, weights.slopes))


def _narrow(model: Machine) -> list[BoolArray]:
    """Per map, the cells (nu, nd) in which the noise of dp flattens a slope."""
    narrow = []
    for edge in model.maps:
        noise = variance(model, edge.source) + variance(model, edge.sink)
        is_narrow = noise > FLATTENED * np.diff(edge.grid.dp_pa) ** 2 / 12.0
        narrow.append(np.broadcast_to(is_narrow, edge.grid.shape))
    return narrow


def _works_there(model: Machine, chunk: FloatArray, narrow: list[BoolArray]) -> bool:
    """True where an edge is open in such a cell for a share FLATTENED of a record, chunk in SI."""
    maps = dict(zip((edge.name for edge in model.maps), narrow, strict=True))
    for edge, owner in zip(model.edges, model.owners, strict=True):
        grid = edge.grid
        w = edge.direction * chunk[:, 2 + model.column(edge.command)]
        dp = pressure_drop(model, edge, chunk[:, 2:])
        at = np.clip(np.searchsorted(grid.dp_pa, dp, side="right") - 1, 0, grid.shape[1] - 1)
        is_open = w > max(edge.safe_band_v, float(grid.u_v[0]))
        if np.mean(is_open & maps[model.edges[owner].name][0, at]) > FLATTENED:
            return True
    return False


def _without_noise(model: Machine, chunk: FloatArray) -> FloatArray:
    """A record, chunk (n, 2 + signals) in SI, with its pressures smoothed within their noise."""
    calm = chunk.copy()
    for name in {end for edge in model.edges for end in (edge.source, edge.sink) if end}:
        column = 2 + model.column(name)
        calm[:, column] = smoothed(chunk[:, column], float(np.sqrt(variance(model, name))))
    return calm


def smoothed(values: FloatArray, sd: float) -> FloatArray:
    """Values (n,) without most of their white noise of deviation sd, in the same unit.

    Each by the parabola over the longest window up to which all windows agree.
    """
    values = np.ascontiguousarray(values)
    best, low, high = values.copy(), values - AGREES * sd, values + AGREES * sd
    agree = np.ones(len(values), bool)
    for half in HALVES:
        if sd == 0.0 or 2 * half + 1 > len(values):
            break
        now, within = fitted(values, half, 0, 1.0), AGREES * sd * noise_left(half)
        low, high = np.maximum(low, now - within), np.minimum(high, now + within)
        agree &= low <= high
        best[agree] = now[agree]
    return best
