"""The small regression of one pass: its noise and priors, and what weighs its rows."""

from __future__ import annotations

import math

import numpy as np

from rtid.diagnose.evidence import ROW_S, Projected, Rows, rows_per_group
from rtid.diagnose.regression import Regression
from rtid.diagnose.revision import Revision
from rtid.effects.column import Columns
from rtid.effects.laws.response import behind_s
from rtid.effects.laws.response import softness as behind_softness
from rtid.effects.laws.storage import softness
from rtid.effects.record_view import RecordView
from rtid.estimator.factor import SHARED_PRIOR
from rtid.estimator.state import Weights, variance
from rtid.model import Machine
from rtid.plain import FloatArray

HELD = 1e30  # information of a parameter that is held
LONG_PAST = 20.0  # time constants of a lag, behind which nothing is left


def softened(
    model: Machine,
    chunk: FloatArray,
    weights: Weights,
    revision: Revision,
    row_s: float = ROW_S,
) -> FloatArray:
    """What a revision adds to the white variance of each row's equation (n, chambers), m6.

    chunk (n, 2 + signals), SI.  The noise n of a pressure moves what is stored, in a row over m
    positions by the mean of V / beta n and of s_i H_i n: an effect takes up s_i per Pa, and what is
    late, H_i, is a mean of the noise itself, which moves a short row less.  That of a measured
    rate stands behind its lag.
    """
    view = RecordView.without_map(model, chunk, weights.compliance)
    nothing = np.broadcast_to(0.0, (view.n, len(model.chambers)))  # which takes no memory
    if not (model.measured or revision.sizes):
        return nothing
    if model.measured:
        return nothing + behind_softness(model, behind_s(revision.timings), view.step_s)
    means, more = rows_per_group(chunk, row_s), np.empty(nothing.shape)
    effects = [(size, *softness(view, effect)) for effect, size in revision.sizes]
    for c, chamber in enumerate(model.chambers):
        plain = view.volume(c) * view.compliance[c]
        late = [
            (size * taken[c], lag_s / view.step_s) for size, taken, lag_s in effects if c in taken
        ]
        noise = variance(model, chamber.pressure) * model.pressure_share
        more[:, c] = (square_of([(plain, 0.0), *late], means) - plain**2) * noise
    return more


def square_of(stored: list[tuple[FloatArray, float]], means: int) -> FloatArray:
    """Variance (n,) of what is stored by white noise of 1 Pa2, in rows, times their length.

    stored: m3/Pa (n,), and how many samples late.
    """
    late = [_of_row(samples, means) for _, samples in stored]
    length = max(map(len, late))
    weights = np.stack([np.pad(w, (0, length - len(w))) for w in late])
    together = means * weights @ weights.T
    each = np.stack([taken for taken, _ in stored])
    return np.einsum("in,ij,jn->n", each, together, each, optimize=True)


def _of_row(samples: float, means: int) -> FloatArray:
    """What each sample of a noise has of a row's mean, behind a first-order lag of so many."""
    fade = math.exp(-1.0 / samples) if samples > 0.0 else 0.0
    passed = (1.0 - fade) * fade ** np.arange(math.ceil(LONG_PAST * samples) + 1.0)
    return np.convolve(passed, np.full(means, 1.0 / means))


def regression_of(
    model: Machine,
    weights: Weights,
    revision: Revision,
    projected: Projected,
    columns: Columns,
    rows: Rows,
    dof: float,
) -> Regression:
    """What the projection has left, the echoes' products as its noise, and the declared priors."""
    n_c, head = len(model.chambers), len(projected.schur)
    noise, prior, mean = np.zeros((head, head)), np.zeros(head), np.zeros(head)
    for a, echo_a in columns.echo_of.items():
        for b, echo_b in columns.echo_of.items():
            noise[a, b] = projected.schur[echo_a, echo_b]
    prior[1 : 1 + n_c] = SHARED_PRIOR
    if not revision.replaces_lag:
        tolerance = model.lag.tolerance_s
        prior[1 + n_c] = tolerance**-2 if tolerance > 0 else HELD
        mean[1 + n_c] = model.lag.nominal_s - weights.lag_s
    return Regression(
        projected.schur, noise, prior, mean, projected.own, dof, rows.n, rows.log_noise
    )
