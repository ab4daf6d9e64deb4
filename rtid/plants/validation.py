"""How good a plant is where it was not fitted: blocks left out in turn, and another record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.plain import FloatArray
from rtid.plants.output_error import INITIAL, LATER, PARAMETERS, PlantFit, fit
from rtid.plants.plant import Plant, PlantRecord
from rtid.plants.simulator import Simulator

FOLDS = 5
FOLD_RUNS = 15  # of a fit to the other blocks, which starts from the fit to all
NOISE_WEIGHT = 20.0  # sum of the squared weights of a third difference


def left_out(plant_fit: PlantFit, folds: int = FOLDS) -> FloatArray:
    """Errors (n, outputs), in their units, of the free run in each block by a fit to the others.

    The run goes through the whole record each time: the inputs are known everywhere, and the states
    begin as in the fit to all (without the first block nothing else would tell).
    """
    simulator = plant_fit.simulator
    block = np.arange(len(plant_fit.residual)) * folds // len(plant_fit.residual)
    errors = np.full_like(plant_fit.residual, np.nan)
    for k in range(folds):
        mask = plant_fit.mask & (block != k)[:, None]
        other = fit(
            plant_fit.plant,
            simulator.record,
            plant_fit.values,
            mask=mask,
            most_runs=FOLD_RUNS,
            sub_steps=simulator.sub_steps,
            fixed_step=True,
            only=PARAMETERS,
        )
        here = block == k
        errors[here] = (simulator.record.y - other.output)[here]
    return np.where(plant_fit.mask, errors, np.nan)


def on_record(plant_fit: PlantFit, record: PlantRecord, *, same_start: bool) -> FloatArray:
    """Errors (n, outputs), in their units, of the free run over another record, none refitted.

    same_start: the states begin as in the record of the fit; else their initial values, and only
    they, are fitted to the new record.  Those behind its gaps are fitted either way.
    """
    plant = replace(plant_fit.plant, parts=len(record.starts))
    n, steps = len(plant.parameters), plant_fit.simulator.sub_steps
    initial = plant_fit.values[n : n + plant.initial_values]
    values = np.concatenate([plant_fit.values[:n], np.tile(initial, plant.parts)])
    if same_start and plant.parts == 1:
        simulator = Simulator(plant, record, steps)
        return np.asarray(record.y - simulator.run(values[:, None])[0][:, :, 0])
    only = LATER if same_start else INITIAL
    return fit(plant, record, values, sub_steps=steps, only=only).residual


def sensor_noise(plant: Plant, record: PlantRecord) -> FloatArray:
    """Noise (outputs,), 1 sigma, in their units: as declared, else from third differences."""
    jumps = np.concatenate([np.diff(y, n=3, axis=0) for y in np.split(record.y, record.starts[1:])])
    guess = np.sqrt(np.nanmean(jumps**2, axis=0) / NOISE_WEIGHT)
    noise = np.array([o.noise for o in plant.outputs])
    return np.where(np.isnan(noise), guess, noise)


def rms(errors: FloatArray) -> FloatArray:
    """Root mean square (outputs,), in their units, NaN left out."""
    return np.asarray(np.sqrt(np.nanmean(errors**2, axis=0)))
