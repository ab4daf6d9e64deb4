"""A fitted plant and the effects inserted into it: one more, one less, one for another."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from rtid.plain import FloatArray, Key
from rtid.plants.entries import RATE
from rtid.plants.insertion import EffectParameter, Insertion, insert
from rtid.plants.output_error import PlantFit, drawn, fit
from rtid.plants.plant import Plant, PlantError, PlantRecord
from rtid.plants.problem import bounds
from rtid.plants.sizes import sized, starts

QUICK_RUNS, POLISHED = 20, 2  # runs of the fit of a candidate, and of how many of its starts
STIFF_STEPS = 4  # at least so many per sample, for an effect that may be fast
MOVED_STARTS, MOVE = 32, 0.3  # starts of a refit around the present values, and how far apart


@dataclass(frozen=True)
class PlantModel:
    """A fitted plant; base: the plant as it was given; effects: what was inserted, in order."""

    base: Plant
    fit: PlantFit
    effects: tuple[tuple[Key, tuple[EffectParameter, ...]], ...] = ()

    @property
    def keys(self) -> tuple[Key, ...]:
        """Effects and places, in the order of their insertion."""
        return tuple(key for key, _ in self.effects)

    def parameters(self, key: Key) -> tuple[EffectParameter, ...]:
        """What an effect has brought in."""
        return dict(self.effects)[key]


def refit(plant: Plant, record: PlantRecord, add: tuple[Key, ...] = ()) -> PlantModel:
    """The fitted plant, with effects added one after the other.  Raises PlantError.

    Behind each gap of the record its free run begins anew, from values of its own.
    """
    plant = replace(plant, parts=len(record.starts))
    model = PlantModel(plant, fit(plant, record))
    for key in add:
        grown = with_effect(model, key)
        if grown is None:
            remedy = "with it the free run leaves every range"
            raise PlantError(f"{key[0]} at {key[1]} cannot be fitted", remedy)
        model = polished(grown)
    return model


def with_effect(model: PlantModel, key: Key) -> PlantModel | None:
    """The model with one effect more, fitted; None where the plant cannot be run with it."""
    rough = roughly(model, key)
    return rough and continued(rough)


def roughly(model: PlantModel, key: Key) -> PlantModel | None:
    """The same after a few runs from the best starts: what it may become is seen there."""
    insertion = sized(insert(model.fit.plant, *key), model.fit)
    return _roughly_fitted(insertion, model, starts(insertion, model.fit))


def continued(model: PlantModel) -> PlantModel:
    """A model that was fitted roughly, fitted on from there."""
    rough = model.fit
    parts = rough.plant, rough.simulator.record, rough.values
    steps = rough.simulator.sub_steps
    done = fit(*parts, most_runs=QUICK_RUNS, sub_steps=steps, fixed_step=True)
    return replace(model, fit=done)


def polished(model: PlantModel) -> PlantModel:
    """The model fitted to the end, with a step that is small enough for it."""
    plant_fit = model.fit
    steps = plant_fit.simulator.sub_steps
    final = fit(plant_fit.plant, plant_fit.simulator.record, plant_fit.values, sub_steps=steps)
    return replace(model, fit=final)


def without(model: PlantModel, key: Key, known_fits: Iterable[PlantFit] = ()) -> PlantModel:
    """The model refitted without one of its effects; known fits may be where to start."""
    present, plant = model.fit, model.base
    for other in model.keys:
        if other != key:
            plant = sized(insert(plant, *other), present).plant
    known = {p.name: p for p in present.plant.parameters}
    plant = replace(plant, parameters=tuple(known.get(p.name, p) for p in plant.parameters))
    simulator = present.simulator
    steps = simulator.sub_steps
    lanes = np.vstack([_around(plant, present), drawn(plant.unknowns), *_known(plant, known_fits)])
    plant_fit = fit(plant, simulator.record, lanes, polished=5, sub_steps=steps, fixed_step=True)
    return PlantModel(model.base, plant_fit, tuple(e for e in model.effects if e[0] != key))


def exchanged(model: PlantModel, reduced: PlantModel, key: Key) -> PlantModel | None:
    """The reduced model with another effect, roughly, from its own values and from the model's."""
    insertion = sized(insert(reduced.fit.plant, *key), reduced.fit)
    lanes = np.vstack([starts(insertion, reduced.fit), starts(insertion, model.fit)])
    return _roughly_fitted(insertion, reduced, lanes)


def _roughly_fitted(
    insertion: Insertion, beside: PlantModel, lanes: FloatArray
) -> PlantModel | None:
    simulator = beside.fit.simulator
    stiff = any(added.kind == RATE for added in insertion.added)
    plant_fit = fit(
        insertion.plant,
        simulator.record,
        lanes,
        polished=POLISHED,
        most_runs=0,
        sub_steps=max(simulator.sub_steps, STIFF_STEPS if stiff else 1),
        fixed_step=True,
    )
    if not np.isfinite(plant_fit.residual[plant_fit.mask]).all():
        return None
    effects = (*beside.effects, (insertion.key, insertion.added))
    return PlantModel(beside.base, plant_fit, effects)


def _known(plant: Plant, fits: Iterable[PlantFit]) -> list[FloatArray]:
    """Values of those fits that know all unknowns of the plant, each as one start."""
    result = []
    for known in fits:
        values = {p.name: v for p, v in zip(known.plant.unknowns, known.values, strict=True)}
        if all(p.name in values for p in plant.unknowns):
            start = np.array([[values[p.name] for p in plant.unknowns]])
            result.append(np.clip(start, *bounds(plant.unknowns)))
    return result


def _around(plant: Plant, present: PlantFit) -> FloatArray:
    """Starts (lanes, unknowns) around the present values."""
    values = {p.name: v for p, v in zip(present.plant.unknowns, present.values, strict=True)}
    start = np.array([values[p.name] for p in plant.unknowns])
    moves = MOVE * np.random.default_rng(2).standard_normal((MOVED_STARTS, len(start)))
    moves[0] = 0.0
    return np.clip(start * np.exp(moves), *bounds(plant.unknowns))
