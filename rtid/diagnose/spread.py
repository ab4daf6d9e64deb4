"""How far the size of an effect is from one number: what a law that is not quite nature's misses.

The intervals of a fit know the noise, and not that a leak's gap widens with pressure or that a
sensor has two lags.  The intervals of a record are dealt into parts by the strength of the effect's
own column, each with as much of its square; where the law holds, each part gives the same size.
With c the sizes of the k parts, V their covariance and W its inverse,

    Q = (c - m)' W (c - m),     t^2 = max(0, Q - (k - 1)) / (tr W - 1' W^2 1 / 1' W 1),

m being their weighted mean: t is the standard deviation of the size from one part to another
(DerSimonian and Laird 1986), and so of what another motion finds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from rtid.diagnose.bank import add_shapes, add_timing
from rtid.diagnose.commands import commands
from rtid.diagnose.evidence import Rows, project
from rtid.diagnose.fit import Fit, columns_of_effects
from rtid.diagnose.moving import LAG_REACH
from rtid.effects.column import Columns
from rtid.effects.law import Volumes
from rtid.effects.laws import total_softness
from rtid.effects.laws.timing import delayed
from rtid.plain import FloatArray
from rtid.units import UNIFORM

PARTS = 4


def with_spreads(fitted: Fit) -> Fit:
    """A fit that knows how far its sizes are from one number; as it is without its rows."""
    if fitted.rows is None or not (fitted.revision.effects or fitted.revision.timings):
        return fitted
    spreads: dict[int, float] = {}
    of_parts = _spreads(fitted, fitted.rows)
    for column, more in chain(of_parts, _of_wholes(fitted), _of_delays(fitted)):
        spreads[column] = float(np.hypot(spreads.get(column, 0.0), more))
    better = replace(fitted, spreads=tuple(spreads.items()))
    vars(better).update(model=fitted.model, sent=fitted.sent, view=fitted.view)
    return better


def _spreads(fitted: Fit, rows: Rows) -> Iterator[tuple[int, float]]:
    """Column and spread of each timing, and of each effect that is a flow.

    What a storage effect's column has of the pressures' noise is another share in each part.
    """
    given = _given(fitted)
    sized = [fitted.timing_columns(k)[0] for k in range(len(fitted.revision.timings))]
    for effect in fitted.revision.effects:
        if not total_softness(fitted.view, ((effect, 1.0),)).any():
            sized.append(fitted.column(effect))
    parts = [part for column in sized for part in _parts(given[column])]
    condensed = [rows.on_rows(column) for column in (*given.values(), *parts)]
    s, n, base = project(rows, condensed).schur, fitted.first_given, list(given)
    prior, mean = (
        of[[*range(1, n), *base]] for of in (fitted.regression.prior, fitted.regression.mean)
    )
    for k, column in enumerate(sized):
        own = np.arange(PARTS) + n + len(base) + PARTS * k
        others = np.delete(np.arange(1, n + len(base)), n - 1 + base.index(column))
        at = np.concatenate([others, own])
        held = np.append(prior[others - 1], np.zeros(PARTS))
        right = s[at, 0] + held * np.append(mean[others - 1], np.zeros(PARTS))
        sizes, cov = _solved(s[np.ix_(at, at)] + np.diag(held), right)
        yield column, spread(sizes[-PARTS:], max(1.0, fitted.rho) * cov[-PARTS:, -PARTS:])


def _of_wholes(fitted: Fit) -> Iterator[tuple[int, float]]:
    """Column and spread of each number of an effect that its shape alone describes.

    What is left may be as much of the effect's own form, or none of it: anything between.
    """
    rest = max(0.0, fitted.held.sse - fitted.regression.dof)
    for effect in fitted.revision.effects:
        if effect.is_whole:
            column = fitted.column(effect)
            without = fitted.regression.fit(tuple(k for k in fitted.held.used if k != column))
            share = np.sqrt(rest / max(without.sse - fitted.held.sse, rest, 1e-300)) / UNIFORM
            for k, at in fitted.shape_columns(effect).items():
                yield at, float(share * abs(effect.shape[k] * fitted.held.value(column)))


def _of_delays(fitted: Fit) -> Iterator[tuple[int, float]]:
    """Column and spread of each delay of a command beside a lag that is free, s.

    A part of a sample shares a step out between two intervals, and what reaches the lag is wider
    than it was by part (1 - part) step^2, as if the spools' lag were longer: their sum stays.  At
    200 samples a second the lag went as far as it may, 0.8 ms, and the delay took as much.
    """
    lag_s, step_s = fitted.weights.lag_s, fitted.view.step_s
    for k, (timing, psi) in enumerate(fitted.revision.timings):
        if timing.apply is delayed:
            part = psi[0] / step_s % 1.0
            wider = part * (1.0 - part) * step_s**2
            longer = float(np.sqrt(lag_s**2 + wider) - lag_s)
            yield fitted.timing_columns(k)[0], min(longer, LAG_REACH * fitted.lag_tolerance_s)


def _given(fitted: Fit) -> dict[int, Volumes]:
    """Volumes per interval of every column of a fit behind those of the compliances."""
    view, revision, given = fitted.view, fitted.revision, list[Volumes]()
    raw = Columns(lambda volumes, _: given.append(volumes))
    add_timing(view, raw, commands(fitted.declared, fitted.chunk), fitted.weights, revision)
    list(add_shapes(view, raw, revision))
    columns = [*range(fitted.first_given, fitted.first), *map(fitted.column, revision.effects)]
    return dict(zip(columns, [*given, *columns_of_effects(fitted)], strict=True))


def _parts(volumes: Volumes) -> list[Volumes]:
    """A column dealt out by its strength, each part with as much of its square."""
    square = np.sum([series**2 for series in volumes.values()], axis=0)
    order = np.argsort(square)
    share = np.empty(len(square))
    share[order] = np.cumsum(square[order]) / max(float(square.sum()), 1e-300)
    part = np.minimum((PARTS * share).astype(int), PARTS - 1)
    return [{c: np.where(part == k, v, 0.0) for c, v in volumes.items()} for k in range(PARTS)]


def _solved(gram: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solution (n,) and inverse (n, n) of products (n, n), scaled on the way."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    outer = np.outer(scale, scale)
    cov = np.linalg.pinv(gram * outer, hermitian=True) * outer
    return cov @ right, cov


def spread(sizes: FloatArray, cov: FloatArray) -> float:
    """Standard deviation t, in their unit, of sizes (k,) beyond their covariance (k, k)."""
    w = np.linalg.pinv(cov, hermitian=True)
    total = float(w.sum())
    if total <= 0.0:
        return 0.0
    off = sizes - float((w @ sizes).sum()) / total
    weight = float(np.trace(w) - (w @ w).sum() / total)
    beyond = float(off @ w @ off) - (len(sizes) - 1)
    return float(np.sqrt(max(0.0, beyond) / weight)) if weight > 0.0 else 0.0
