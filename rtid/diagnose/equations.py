"""The small regression of one pass: its noise and priors, and what weighs its rows."""

from __future__ import annotations

import numpy as np

from rtid.diagnose.evidence import Projected, Rows
from rtid.diagnose.regression import Regression
from rtid.diagnose.revision import Revision
from rtid.effects.column import Columns
from rtid.effects.laws import total_softness
from rtid.effects.laws.response import behind_s
from rtid.effects.laws.response import softness as behind_softness
from rtid.effects.record_view import RecordView
from rtid.estimator.factor import SHARED_PRIOR
from rtid.estimator.state import Weights, variance
from rtid.model import Machine
from rtid.plain import FloatArray

HELD = 1e30  # information of a parameter that is held


def softened(model: Machine, chunk: FloatArray, weights: Weights, revision: Revision) -> FloatArray:
    """What a revision adds to the white variance of each row's equation (n, chambers), m6.

    The noise of a pressure moves what is stored: sd_P times V / beta and the effects' own share;
    that of a measured rate stands behind its lag.
    """
    view = RecordView.without_map(model, chunk, weights.compliance)
    nothing = np.broadcast_to(0.0, (view.n, len(model.chambers)))  # which takes no memory
    if not (model.measured or revision.sizes):
        return nothing
    if model.measured:
        return nothing + behind_softness(model, behind_s(revision.timings), view.step_s)
    softness, more = total_softness(view, revision.sizes), np.empty(nothing.shape)
    for c, chamber in enumerate(model.chambers):
        plain = view.volume(c) * view.compliance[c]
        noise = variance(model, chamber.pressure) * model.pressure_share
        more[:, c] = ((plain + softness[:, c]) ** 2 - plain**2) * noise
    return more


def regression_of(
    model: Machine,
    weights: Weights,
    revision: Revision,
    projected: Projected,
    columns: Columns,
    rows: Rows,
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
        projected.schur,
        noise,
        prior,
        mean,
        projected.own,
        rows.due,
        rows.n,
        rows.log_noise,
        rows.weighed,
    )
