"""The echoes of the pressures' noise in whatever a chamber stores beside its oil."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from itertools import chain

import numpy as np

from rtid.effects.column import Candidate, Cause, Columns
from rtid.effects.law import Placed, Shape, Volumes, lagged, placed_on
from rtid.effects.laws.common import stored
from rtid.effects.laws.lines import LINE, line_echo, line_softness
from rtid.effects.record_view import RecordView
from rtid.estimator.state import variance
from rtid.plain import FloatArray

SEED = 20051005  # of the noise that stands for the sensors' own


def add_echoes(
    view: RecordView, columns: Columns, first: int, slopes: list[tuple[Cause, Shape, int]]
) -> None:
    """Echoes of theta_beta and of every storage column: the same columns of noise alone.

    first: number of given columns before the slopes and the candidates; slopes: cause, shape and
    parameter of each derivative column.
    """
    rng = np.random.default_rng(SEED)
    n_c, noise = len(view.model.chambers), {}
    for c, chamber in enumerate(view.model.chambers):
        sd = np.sqrt(variance(view.model, chamber.pressure) * view.model.pressure_share)
        noise[c] = sd * rng.standard_normal(view.n)
        echo = columns.add({c: view.compliance[c] * stored(view, c, noise[c])})
        columns.echo_of[1 + c] = 1 + n_c + echo

    def echo_of(cause: Cause, shape: Shape) -> Volumes:
        return _echo(view, cause.at(shape), noise)

    of_slopes = (cause.slope_of(partial(echo_of, cause), shape, k) for cause, shape, k in slopes)
    of_all = (_echo(view, candidate, noise) for candidate in columns.candidates)
    beside = len(slopes) + columns.n_beside
    for k, by_chamber in enumerate(chain(of_slopes, of_all)):  # one at a time: each is a record
        if by_chamber:
            echo = columns.add(by_chamber, is_aside=k >= beside)
            columns.echo_of[1 + n_c + first + k] = 1 + n_c + echo


def _echo(view: RecordView, candidate: Candidate, noise: Volumes) -> Volumes:
    """What a storage effect makes of the pressures' noise alone, chamber -> (n,) Pa; {} else."""
    if candidate.law.law == LINE:
        return line_echo(view, candidate, noise)
    placed = _placed(view, candidate)
    if placed is None:
        return {}
    taken_up, lag_s = placed.softness(view, candidate.shape), placed.lag_s(candidate.shape)
    return {c: -np.diff(lagged(m * noise[c], view.step_s, lag_s)) for c, m in taken_up.items()}


def softness(view: RecordView, candidate: Candidate) -> Volumes:
    """What one unit of a storage effect takes up per Pa, by chamber (n,), m3/Pa; {} for others."""
    if candidate.law.law == LINE:
        return line_softness(view, candidate)
    placed = _placed(view, candidate)
    return placed.softness(view, candidate.shape) if placed is not None else {}


def _placed(view: RecordView, candidate: Candidate) -> Placed | None:
    """An effect by its equation where it sits; None for a law by name."""
    if candidate.law.law:
        return None
    places = placed_on(view, candidate.law)
    return next((placed for placed in places if placed.where == candidate.where), None)


def total_softness(view: RecordView, sizes: Iterable[tuple[Candidate, float]]) -> FloatArray:
    """What effects of these sizes take up per Pa (n, chambers), m3/Pa."""
    total = np.zeros((view.n, len(view.model.chambers)))
    for candidate, size in sizes:
        for c, taken in softness(view, candidate).items():
            total[:, c] += size * taken
    return total
