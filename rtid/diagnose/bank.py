"""Columns of one pass: derivatives of what may move, effects of the revision, all to be scored."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from rtid.diagnose.commands import change_of, half_of, through
from rtid.diagnose.regression import Estimate
from rtid.diagnose.revision import Revision
from rtid.effects.column import Candidate, Cause, Columns
from rtid.effects.law import Shape, Volumes
from rtid.effects.laws import add_echoes, cause_of, causes
from rtid.effects.laws.common import supply_change
from rtid.effects.laws.pump import demand
from rtid.effects.laws.sensors import late
from rtid.effects.laws.timing import COMMAND, SUPPLY, timings_of
from rtid.effects.laws.timing import lagged as lagged_command
from rtid.effects.page import Effect
from rtid.effects.record_view import RecordView
from rtid.estimator.state import Weights
from rtid.plain import FloatArray

LAG_STEP_S = 5e-5


def columns_of(
    view: RecordView, take: Callable[[Volumes, bool], object],
    sent: dict[str, tuple[int, FloatArray]], weights: Weights, revision: Revision,
    bank: bool = False, more: Iterable[tuple[Cause, Shape]] = (), suspects: tuple[Effect, ...] = (),
) -> tuple[Columns, int, tuple[tuple[int, int], ...]]:  # fmt: skip
    """Every column of a fit behind the compliances, echoes last, as `fit.one_pass` has them.

    take: as of `Columns`; sent: the commands (n,), V, before any timing.  With the number of
    timings' columns, and effect and nonlinear parameter of each column of shapes.
    """
    columns = Columns(take)
    n_timing = add_timing(view, columns, sent, weights, revision)
    shapes = tuple(add_shapes(view, columns, revision))
    offer(view, columns, revision, bank, more, suspects)
    slopes = [(cause_of(view, e), e.shape, k) for i, k in shapes for e in [revision.effects[i]]]
    view.rest()  # echoes ask little of it
    add_echoes(view, columns, n_timing, slopes)
    return columns.ended(), n_timing, shapes


def add_timing(
    view: RecordView, columns: Columns, sent: dict[str, tuple[int, FloatArray]], weights: Weights,
    revision: Revision,
) -> int:  # fmt: skip
    """Derivative columns of the lag and of every timing parameter; their number.

    sent: the commands (n,), V, before any timing.
    """
    dt_s, instants, n = view.step_s, view.instants, 0
    if not revision.replaces_lag:
        columns.add(opening_change(view, _slower(view, weights.lag_s)))
        n += 1
    for k, (timing, psi) in enumerate(revision.timings):
        for j in range(len(psi)):
            if timing.where == SUPPLY:
                columns.add(supply_change(view, -timing.change(demand(view), 1, dt_s, psi, j)))
            elif timing.of_sensor:
                columns.add(late(view, timing, psi))
            else:
                change = {
                    name: change_of(u, d, instants, revision.timings, k, j)
                    for name, (d, u) in sent.items()
                }
                columns.add(opening_change(view, change))
            n += 1
    return n


def _slower(view: RecordView, lag_s: float) -> dict[str, FloatArray]:
    """How the commands at the spools (n,) follow the lag, V/s."""
    above, below = lag_s + LAG_STEP_S, max(0.0, lag_s - LAG_STEP_S)
    even_s = view.instants.even_s

    def slower(u: FloatArray) -> FloatArray:
        rise = lagged_command(u, even_s, (above,)) - lagged_command(u, even_s, (below,))
        return rise / (above - below)

    return {name: view.instants.over(u, slower) for name, (_, u) in _at_spools(view).items()}


def add_shapes(view: RecordView, columns: Columns, revision: Revision) -> Iterator[tuple[int, int]]:
    """Derivative columns of the nonlinear parameters of effects, but for those that are none, 0.

    At an end of its range one may still point back (`pointing_out`): air that was scored beside an
    oil as it was bent stood at the end of its exponents, and had no way to the 1.2 of the truth.
    """
    for e, effect in enumerate(revision.effects):
        cause = cause_of(view, effect)
        for k, value in enumerate(effect.shape):
            low, high = cause.bounds(k)
            is_open = low < value < high or (value != 0.0 and low < high)
            slope = cause.slope(effect.shape, k) if is_open else {}
            if any(np.any(series != 0.0) for series in slope.values()):
                columns.add(slope)
                yield e, k


def pointing_out(
    view: RecordView,
    revision: Revision,
    shapes: tuple[tuple[int, int], ...],
    first: int,
    sizes: list[int],
    estimate: Estimate,
) -> set[int]:
    """Columns of nonlinear parameters at an end of their range that an estimate takes beyond it.

    shapes: as of a fit, in columns from first on; sizes: the columns of the effects.
    """
    out = set()
    for column, (e, k) in enumerate(shapes, first):
        effect = revision.effects[e]
        low, high = cause_of(view, effect).bounds(k)
        ways = [way for end, way in ((low, -1.0), (high, 1.0)) if effect.shape[k] == end]
        if ways and column in estimate.used:
            moved = estimate.value(column) * estimate.value(sizes[e])
            out |= {column for way in ways if moved * way >= 0.0}
    return out


def _at_spools(view: RecordView) -> dict[str, tuple[int, FloatArray]]:
    """Direction and command (n,), V, as it reaches the spools, by the names of a split machine."""
    return {half_of(e): (e.direction, view.signal(e.command)) for e in view.model.edges}


def opening_change(view: RecordView, change: dict[str, FloatArray]) -> Volumes:
    """Volumes (n - 1,), m3, per chamber of a small change of commands (n,), V, in the blocks."""
    flows = [
        view.slope_u(i) * edge.direction * change[half_of(edge)][:-1]
        for i, edge in enumerate(view.model.edges)
    ]
    n_c = len(view.model.chambers)
    return {c: view.into_chamber(c, flows) * view.dt_s for c in range(n_c)}


def _every(_candidate: Candidate) -> bool:
    return True


def offer(
    view: RecordView,
    columns: Columns,
    revision: Revision,
    bank: bool,
    more: Iterable[tuple[Cause, Shape]],
    suspects: tuple[Effect, ...],
    wants: Callable[[Candidate], bool] = _every,
) -> None:
    """Columns of the revision's effects, and of all that is to be scored: suspects as well.

    wants: asked before a column of the bank is made, which takes long.
    """
    for effect in revision.effects:
        columns.offer(effect, cause_of(view, effect).column(effect.shape), is_aside=False)
    for cause in causes(view, suspects) if bank else ():
        if cause.offered and not any(map(cause.makes, revision.effects)):
            for candidate in filter(wants, map(cause.at, cause.shapes)):
                volumes = cause.column(candidate.shape)
                if any(series.any() for series in volumes.values()):  # else it cannot act here
                    columns.offer(candidate, volumes)
    for cause, shape in more:
        columns.offer(cause.at(shape), cause.column(shape))
    if bank:
        _offer_timings(view, columns, revision, wants)


def _offer_timings(
    view: RecordView, columns: Columns, revision: Revision, wants: Callable[[Candidate], bool]
) -> None:
    """What each timing of the bank would change, first order in the opening; coefficient 1."""
    halves = _at_spools(view)
    for timing in timings_of(view.model, view.chunk):
        if revision.has((timing.effect, COMMAND)) or timing.own_spools or timing.is_within_lag:
            continue
        for psi in timing.bank:
            candidate = Candidate(
                timing.effect, COMMAND, "share", "1", 20.0, shape=psi[:1],
                shape_names=timing.parameters[:1], shape_units=timing.units[:1],
            )  # fmt: skip
            if wants(candidate):
                change = {
                    name: through(u, d, view.instants, ((timing, psi),)) - u
                    for name, (d, u) in halves.items()
                }
                columns.offer(candidate, opening_change(view, change))
