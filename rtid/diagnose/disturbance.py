"""How much moves a plant beside its command: the white noise of its rate that a record shows.

Without pressures the load, the supply and whatever else moves the machine enter the rate unseen:
far more than the sensor's noise.  Rows that are weighed for the sensor alone would follow
slow disturbances instead of the map.  So the disturbance is as large as makes the residual variance
of the model as it is one: with an effect more, it is found anew, and smaller.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.diagnose.fit import one_pass, prepare
from rtid.diagnose.parts import AddedEffect, recall
from rtid.diagnose.revision import Revision
from rtid.effects.page import Effect
from rtid.model import Machine
from rtid.plain import FloatArray

STEPS = 8  # halvings of a decade range
LEAST, MOST = 1e-4, 1e2  # of the largest map's size, per sqrt(Hz)


def with_disturbance(
    model: Machine,
    chunk: FloatArray,
    parts: tuple[AddedEffect, ...] = (),
    suspects: tuple[Effect, ...] = (),
) -> Machine:
    """The machine with the disturbance of a record, chunk (n, 2 + signals), SI; 0 if it shows none.

    parts: effects that the model has.  A disturbance that is declared stays.
    """
    if model.has_pressures or model.chambers[0].disturbance > 0.0:
        return model
    revision = Revision()
    if parts:
        revision = recall(model, chunk, prepare(model, chunk), parts, suspects)

    def excess(size: float) -> float:
        machine = disturbed(model, size)
        rho = one_pass(machine, chunk, prepare(machine, chunk), revision, None, False).rho
        return rho - 1.0 if rho >= 0.0 else np.inf  # rows of next to no noise: nothing but rounding

    if excess(0.0) <= 0.0:
        return model
    rated = max(edge.rated_q_m3s for edge in model.edges)
    low, high = np.log(LEAST * rated), np.log(MOST * rated)
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        if excess(float(np.exp(middle))) > 0.0:
            low = middle
        else:
            high = middle
    return disturbed(model, float(np.exp(0.5 * (low + high))))


def disturbed(model: Machine, size: float) -> Machine:
    """The machine with a disturbance of each rate, SI unit per sqrt(Hz)."""
    chambers = tuple(replace(chamber, disturbance=size) for chamber in model.chambers)
    return replace(model, chambers=chambers)
