"""Extra flows: what effects add to the right-hand side of (14), carried through every comparison.

Per chamber the volume that has flowed in is one more signal E, and a shared term that is its rate,

    extra flow = dE/dt,   exactly the given mean over each interval,

so that the kernels need to know nothing of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.errors import RtidError
from rtid.model import Machine, Signal, Term
from rtid.plain import FloatArray

VOLUME = "volume"  # kind of a signal that nobody has measured


class ExtraFlowError(RtidError):
    """Extra flows of another shape than the record, or not finite."""


def with_extra_flow(
    model: Machine,
    terms: FloatArray,
    chunk: FloatArray,
    extra_flow: FloatArray | None,
    name: str = "extra flow",
) -> tuple[Machine, FloatArray, FloatArray]:
    """Model, coefficients of its shared terms and samples, with extra_flow (n - 1, chambers), m3/s.

    Positive into the chamber; name: of the flow, where there are several.  Raises ExtraFlowError.
    """
    if extra_flow is None:
        return model, terms, chunk
    flow, wanted = np.asarray(extra_flow, float), (max(len(chunk) - 1, 0), len(model.chambers))
    if flow.shape != wanted or not np.isfinite(flow).all():
        text = f"an extra flow of shape {flow.shape}, finite: {bool(np.isfinite(flow).all())}"
        raise ExtraFlowError(text, f"give finite m3/s of shape {wanted}: intervals, chambers")
    names = [f"{name} {chamber.name}" for chamber in model.chambers]
    signals = tuple(Signal(name, VOLUME, "m3") for name in names)
    added = tuple(
        Term(name, ((name, -1.0),), ((chamber.name, 1),), 1.0, rate=True)
        for name, chamber in zip(names, model.chambers, strict=True)
    )
    volume = np.zeros((len(chunk), len(names)))
    np.cumsum(flow * np.diff(chunk[:, :1], axis=0), axis=0, out=volume[1:])
    larger = replace(model, signals=(*model.signals, *signals), terms=(*model.terms, *added))
    coefficients = np.concatenate([terms, np.ones(len(names))])
    return larger, coefficients, np.hstack([chunk, volume])
