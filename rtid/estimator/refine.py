"""Grid refinement: narrower intervals where a block's terms miss the flow by more than the noise.

A block whose innovations exceed unit variance holds what its six terms cannot follow, as a rule the
corner of the dead band, or where a valve's law bends.  The intervals with the largest excess are
halved; whether that is worth its new unknowns is for the fit to say (`rtid.diagnose.finer`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtid.estimator.misfit import Misfit
from rtid.estimator.state import variance
from rtid.kernels.layout import MAX_BORDERS
from rtid.model import COMMAND_ONLY, DROP_ONLY, PROPORTIONAL, Edge, Grid, Machine
from rtid.plain import BoolArray, FloatArray, IntArray

AT_ONCE = 2  # intervals halved per axis and edge in one round
CLEARLY = 4.0  # standard deviations above unit variance
LEAST_ROWS = 200  # in an interval: fewer cannot tell a misfit from a few odd rows
WHOLE = (0, DROP_ONLY), (1, COMMAND_ONLY)  # axes along which such maps do not change: never halved
FLATTENED = 0.1  # of a slope, at most, by the noise of dp in an interval that it goes all over
LEAST_SHARE = 0.2  # of an edge's excess that an interval must hold


@dataclass(frozen=True)
class Excess:
    """Per cell of one edge (nu, nd): rows seen, and squared innovations beyond one each."""

    rows: FloatArray
    beyond: FloatArray


def halved(model: Machine, misfit: Misfit, clearly: float = CLEARLY) -> Machine:
    """The machine with its worst intervals halved; as it is where none clearly misses the flow.

    misfit: in units of the noise alone, nothing excused; clearly: standard deviations of excess.
    """
    result = _excesses_of_maps(model, misfit)
    pairs = zip(model.edges, result, strict=True)
    return _on(model, [_halved(model, edge, excess, clearly).grid for edge, excess in pairs])


def halved_along(model: Machine, axis: int) -> Machine:
    """The machine with all intervals halved along an axis: 0 the command, 1 the pressure drop.

    Of maps that do not change along it, and of proportional ones, none is, nor any interval of dp
    in whose halves its noise would flatten the slopes.
    """
    return _on(model, [_halved_along(model, edge, axis) for edge in model.edges])


def missing_commands(model: Machine, misfit: Misfit) -> list[list[int]]:
    """Per edge, the intervals of its command that miss the flow most; of its owner where shared."""
    return [
        _worst(excess, 0, CLEARLY) if edge.terms != DROP_ONLY and edge.basis != PROPORTIONAL else []
        for edge, excess in zip(model.edges, _excesses_of_maps(model, misfit), strict=True)
    ]


def cut(model: Machine, at_v: list[list[float]]) -> Machine:
    """The machine with more borders along the command, those of each edge in volts.

    As it is where there is no room for so many.
    """
    grids = [
        Grid(np.unique(np.append(edge.grid.u_v, more)), edge.grid.dp_pa)
        for edge, more in zip(model.edges, at_v, strict=True)
    ]
    has_room = all(len(grid.u_v) <= MAX_BORDERS for grid in grids)
    return _on(model, grids) if has_room else model


def in_halved(model: Machine, finer: Machine, misfit: Misfit) -> BoolArray:
    """Rows (n - 1,) with a working point in an interval that the finer machine has halved."""
    here = np.zeros(len(misfit.cells), bool)
    for i, (edge, new) in enumerate(zip(model.edges, finer.edges, strict=True)):
        pairs = (new.grid.u_v, edge.grid.u_v), (new.grid.dp_pa, edge.grid.dp_pa)
        u, dp = (np.diff(np.searchsorted(fine, coarse)) > 1 for fine, coarse in pairs)
        place = misfit.cells[:, i] - model.first_cells[i]
        here |= (place >= 0) & (u[:, None] | dp).ravel()[np.maximum(place, 0)]
    return here


def parents(model: Machine, finer: Machine) -> IntArray:
    """Per cell of a finer machine's maps (cells,), the model's cell that its middle lies in."""
    result, first = [np.zeros(0, np.int64)], 0
    for edge, new in zip(model.maps, finer.maps, strict=True):
        pairs = (edge.grid.u_v, new.grid.u_v), (edge.grid.dp_pa, new.grid.dp_pa)
        u, dp = (np.searchsorted(coarse, 0.5 * (b[1:] + b[:-1])) - 1 for coarse, b in pairs)
        result.append(first + (u[:, None] * edge.grid.shape[1] + dp).ravel())
        first += edge.grid.shape[0] * edge.grid.shape[1]
    return np.concatenate(result)


def excesses(model: Machine, misfit: Misfit) -> list[Excess]:
    """Where the innovations of a fit exceed the noise, per edge."""
    square = (misfit.innovation**2).mean(axis=1) - 1.0
    known = np.isfinite(square)
    result = []
    for i, (edge, first) in enumerate(zip(model.edges, model.first_cells, strict=True)):
        size = edge.grid.shape[0] * edge.grid.shape[1]
        place = misfit.cells[known, i] - first
        here = (place >= 0) & (place < size)
        rows = np.bincount(place[here], minlength=size).astype(np.float64)
        total = np.bincount(place[here], square[known][here], size).astype(np.float64)
        result.append(Excess(rows.reshape(edge.grid.shape), total.reshape(edge.grid.shape)))
    return result


def _on(model: Machine, grids: list[Grid]) -> Machine:
    """The machine on these grids of its edges; commands that share a map share its owner's."""
    pairs = zip(model.edges, model.owners, strict=True)
    return replace(model, edges=tuple(replace(e, grid=grids[o]) for e, o in pairs))


def _excesses_of_maps(model: Machine, misfit: Misfit) -> list[Excess]:
    """As `excesses`; what is missed of a shared map shows at all its commands."""
    result = excesses(model, misfit)
    for i, owner in enumerate(model.owners):
        if i != owner:
            mine, whole = result[i], result[owner]
            result[owner] = Excess(whole.rows + mine.rows, whole.beyond + mine.beyond)
    return result


def _halved(model: Machine, edge: Edge, excess: Excess, clearly: float) -> Edge:
    """The edge with its worst intervals halved; as it is where none is clearly above the noise.

    A proportional map has one gain in each block on purpose: two of them would jump in between.
    """
    if edge.basis == PROPORTIONAL:
        return edge
    axes = [_worst(excess, axis, clearly) if edge.terms != whole else [] for axis, whole in WHOLE]
    axes[1] = _wide(model, edge, axes[1])
    u, dp = (_split(b, k) for b, k in zip((edge.grid.u_v, edge.grid.dp_pa), axes, strict=True))
    return replace(edge, grid=Grid(u, dp))


def _halved_along(model: Machine, edge: Edge, axis: int) -> Grid:
    borders = [edge.grid.u_v, edge.grid.dp_pa]
    n = len(borders[axis]) - 1
    is_whole = edge.basis == PROPORTIONAL or (axis, edge.terms) in WHOLE
    if not is_whole and 2 * n < MAX_BORDERS:
        every = list(range(n))
        borders[axis] = _split(borders[axis], _wide(model, edge, every) if axis else every)
    return Grid(*borders)


def _wide(model: Machine, edge: Edge, intervals: list[int]) -> list[int]:
    """Those of an edge's intervals of dp in whose halves its noise flattens no slope by much.

    By s^2 / (S + s^2), where dp goes over a half with the variance S.  A bulk modulus went from 894
    to 954 MPa with intervals of 87 kPa at 11 kPa of noise, where 879 was true.
    """
    noise = variance(model, edge.source) + variance(model, edge.sink)
    half = 0.5 * np.diff(edge.grid.dp_pa)
    is_wide = noise <= FLATTENED * (noise + half**2 / 12.0)
    return [k for k in intervals if is_wide[k]]


def _worst(excess: Excess, axis: int, clearly: float) -> list[int]:
    """Intervals along an axis whose excess is clear and holds a fair share of all of it."""
    rows, beyond = excess.rows.sum(axis=1 - axis), excess.beyond.sum(axis=1 - axis)
    clear = _is_clear(rows, beyond, clearly)
    share = beyond > LEAST_SHARE * max(float(beyond[beyond > 0].sum()), 1e-12)
    worst = np.argsort(-beyond)[: max(0, min(AT_ONCE, MAX_BORDERS - 2 - len(rows)))]
    return [int(k) for k in worst if clear[k] and share[k]]


def _is_clear(rows: FloatArray, beyond: FloatArray, clearly: float) -> BoolArray:
    """Intervals (n,) of enough rows whose excess is more than so many standard deviations."""
    return np.asarray((rows >= LEAST_ROWS) & (beyond > clearly * np.sqrt(2.0 * rows)))


def _split(border: FloatArray, intervals: list[int]) -> FloatArray:
    middle = [0.5 * (border[k] + border[k + 1]) for k in intervals]
    return np.sort(np.concatenate([border, middle]))
