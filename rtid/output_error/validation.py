"""How good a plant is where it was not fitted: blocks left out in turn, and another record."""

from __future__ import annotations

import numpy as np

from rtid.effects.tree import FloatArray
from rtid.output_error.fit import INITIAL, PARAMETERS, Fit, fit
from rtid.output_error.plant import Plant, Record
from rtid.output_error.simulation import Simulator

FOLDS = 5
FOLD_RUNS = 15  # of a fit to the other blocks, which starts from the fit to all
NOISE_WEIGHT = 20.0  # sum of the squared weights of a third difference


def left_out(found: Fit, folds: int = FOLDS) -> FloatArray:
    """Errors (n, outputs) of the free run in each block by a fit to the other blocks.

    The run goes through the whole record each time: the inputs are known everywhere, and the states
    begin as in the fit to all (without the first block nothing else would tell).
    """
    simulator = found.simulator
    block = np.arange(len(found.residual)) * folds // len(found.residual)
    errors = np.full_like(found.residual, np.nan)
    for k in range(folds):
        mask = found.mask & (block != k)[:, None]
        other = fit(
            found.plant,
            simulator.record,
            found.values,
            mask=mask,
            most_runs=FOLD_RUNS,
            sub_steps=simulator.sub_steps,
            fixed_step=True,
            only=PARAMETERS,
        )
        here = block == k
        errors[here] = (simulator.record.y - other.output)[here]
    return np.where(found.mask, errors, np.nan)


def on_record(found: Fit, record: Record, *, same_start: bool) -> FloatArray:
    """Errors (n, outputs) of the free run over another record, no parameter refitted.

    same_start: the states begin as in the record of the fit; else their initial values, and only
    they, are fitted to the new record.
    """
    if same_start:
        simulator = Simulator(found.plant, record, found.simulator.sub_steps)
        return np.asarray(record.y - simulator.run(found.values[:, None])[0][:, :, 0])
    steps = found.simulator.sub_steps
    other = fit(found.plant, record, found.values, sub_steps=steps, only=INITIAL)
    return other.residual


def sensor_noise(plant: Plant, record: Record) -> FloatArray:
    """Noise (outputs,), 1 sigma: as it is declared, else from third differences of the output."""
    jumps = np.diff(record.y, n=3, axis=0)
    guess = np.sqrt(np.nanmean(jumps**2, axis=0) / NOISE_WEIGHT)
    told = np.array([o.noise for o in plant.outputs])
    return np.where(np.isnan(told), guess, told)


def rms(errors: FloatArray) -> FloatArray:
    """Root mean square per output (outputs,), NaN left out."""
    return np.asarray(np.sqrt(np.nanmean(errors**2, axis=0)))
