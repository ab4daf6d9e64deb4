"""The free run of a plant that is a rate: its state from where it begins, by the model alone.

x(t) = x(0) + integral of f(u) and of all effects, which is never put right by the measurement: what
a model has of the slow motion shows here, where a rate's error is mostly of the fast one.
"""

from __future__ import annotations

import numpy as np

from firmware_bridge.samples import GAP
from rtid.diagnose.fit import Fit
from rtid.diagnose.residual import effect_values, transformed_like
from rtid.effects.laws import cause_of
from rtid.effects.record_view import RecordView
from rtid.estimator.flowmap import FlowMap
from rtid.plain import FloatArray
from rtid.study.known_effects import everywhere


def run_error(fit: Fit, published: FlowMap, chunk: FloatArray) -> FloatArray:
    """Measured minus simulated state at the samples (n,) of a chunk (n, 2 + signals), SI.

    published: the learned map.  Over a gap, and off the grid, the state moves as it was measured;
    where the line is broken between samples that are no gap apart, as where a pump turns, it runs.
    """
    sent = transformed_like(fit, _unbroken(chunk, fit.model.gates.max_gap_s))
    model = fit.model.with_taylor_maps
    view = RecordView.of(model, sent, fit.weights, everywhere(model, published))
    step = view.chamber_flow(0) * view.dt_s
    for effect, value in effect_values(fit):
        step = step + value * cause_of(view, effect).column(effect.shape)[0]
    step = np.where(view.inside, step, np.diff(view.x_m))
    moved = np.concatenate([[0.0], np.cumsum(step)])
    return np.asarray(view.x_m - view.x_m[0] - moved)


def _unbroken(chunk: FloatArray, max_gap_s: float) -> FloatArray:
    """The chunk (n, 2 + signals) without marks of gaps behind steps that are none."""
    chunk = chunk.copy()
    is_near = np.diff(chunk[:, 0], prepend=chunk[:1, 0]) <= max_gap_s
    flags = chunk[:, 1].astype(np.int64)
    chunk[:, 1] = np.where(is_near, flags & ~int(GAP), flags)
    return chunk
