"""A plant that is ready to run over a record, for one or many sets of parameters at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from rtid.plain import FloatArray
from rtid.plants.plant import FIRST_ORDER, Plant, PlantError, PlantRecord
from rtid.plants.program import Program, compiled
from rtid.plants.runge_kutta import free_run, play

MOST_SUB_STEPS = 64
STEP_ERROR = 1e-3  # of the outputs' standard deviation: what halving the step may change


@dataclass(frozen=True)
class Simulator:
    """Free runs of a plant over the instants and inputs of a record; sub_steps per usual sample.

    A plant of more than one part begins anew behind each gap of the record.
    """

    plant: Plant
    record: PlantRecord
    sub_steps: int = 1

    @cached_property
    def program(self) -> Program:
        """The plant's equations as instructions."""
        return compiled(self.plant)

    @cached_property
    def first_order(self) -> FloatArray:
        """1 for every input (inputs,) that is linear between samples, a share, else 0."""
        return np.array([float(i.hold == FIRST_ORDER) for i in self.plant.inputs])

    def run(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outputs (n, outputs, lanes) and states (n, states, lanes); NaN where a run diverges.

        values (unknowns, lanes), in their units: parameters, then initial values, in the order
        of `plant.unknowns`.
        """
        plant, program, record = self.plant, self.program, self.record
        n_parameters, lanes = len(plant.parameters), values.shape[1]
        first = len(plant.states) + len(plant.inputs)
        r = np.zeros((program.registers, lanes))
        r[first : first + n_parameters] = values[:n_parameters]
        last = program.first_number + len(program.numbers)
        r[program.first_number : last] = program.numbers[:, None]
        y = np.empty((len(record.t_s), len(plant.outputs), lanes))
        states = np.empty((len(record.t_s), len(plant.states), lanes))
        delays, step_s = self._delays(values), float(np.median(np.diff(record.t_s)))
        for part, rows in enumerate(self.parts):
            u = np.ascontiguousarray(record.u[rows])
            total = np.zeros_like(u)
            total[1:] = np.cumsum(u[:-1] * np.diff(record.t_s[rows])[:, None], axis=0)
            free_run(
                program.rate_code,
                program.rates,
                program.output_code,
                program.outputs,
                r,
                self._initial(values, part, u[0]),
                record.t_s[rows],
                u,
                total,
                self.first_order,
                delays,
                step_s / self.sub_steps,
                y[rows],
                states[rows],
            )
            self._play(y[rows], values)
        return y, states

    @cached_property
    def parts(self) -> list[slice]:
        """Rows of the record over which the plant runs in one go."""
        starts = [0] if self.plant.parts == 1 else self.record.starts.tolist()
        return [slice(*ends) for ends in pairwise([*starts, len(self.record.t_s)])]

    def _initial(self, values: FloatArray, part: int, u: FloatArray) -> FloatArray:
        """States at the first sample of a part (states, lanes), where the inputs are u."""
        x = np.empty((len(self.plant.states), values.shape[1]))
        names = [i.name for i in self.plant.inputs]
        first = len(self.plant.parameters) + part * self.plant.initial_values
        free = iter(values[first:])
        for row, state in zip(x, self.plant.states, strict=True):
            row[:] = u[names.index(state.follows)] if state.follows else next(free)
        return x

    def _of(self, values: FloatArray, name: str) -> FloatArray:
        index = [p.name for p in self.plant.parameters].index(name)
        return np.asarray(values[index])

    def _delays(self, values: FloatArray) -> FloatArray:
        delays = np.zeros((len(self.plant.inputs), values.shape[1]))
        for row, given in zip(delays, self.plant.inputs, strict=True):
            if given.delay:
                row[:] = self._of(values, given.delay)
        return delays

    def _play(self, y: FloatArray, values: FloatArray) -> None:
        for o, output in enumerate(self.plant.outputs):
            if output.play:
                _behind_gap(y[:, o], self._of(values, output.play))


def _behind_gap(z: FloatArray, width: FloatArray) -> None:
    """Move every lane of z (n, lanes) behind its gap, in place."""
    for j in range(z.shape[1]):
        moved = np.empty(len(z))
        play(np.ascontiguousarray(z[:, j]), max(float(width[j]), 0.0), moved)
        z[:, j] = moved


def resolved(plant: Plant, record: PlantRecord, values: FloatArray, least: int = 1) -> Simulator:
    """The simulator whose step is small enough at values (unknowns,), in their units.

    Raises PlantError if the plant runs away however small the step is.
    """
    steps, coarse = least, _outputs(plant, record, values, least)
    while steps < MOST_SUB_STEPS:
        fine = _outputs(plant, record, values, 2 * steps)
        spread = np.nanstd(record.y, axis=0) + 1e-300
        if np.isfinite(coarse).all() and np.abs((fine - coarse) / spread).max() < STEP_ERROR:
            return Simulator(plant, record, steps)
        steps, coarse = 2 * steps, fine
    if not np.isfinite(coarse).all():
        remedy = "check the signs of the equations, the start values and the bounds"
        raise PlantError(f"{plant.name}: the free run leaves every range", remedy)
    return Simulator(plant, record, steps)


def _outputs(plant: Plant, record: PlantRecord, values: FloatArray, sub_steps: int) -> FloatArray:
    return Simulator(plant, record, sub_steps).run(values[:, None])[0][:, :, 0]
