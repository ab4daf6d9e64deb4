"""A plant that is ready to run over a record, for one or many sets of parameters at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rtid.effects.tree import FloatArray
from rtid.output_error.plant import FIRST_ORDER, Plant, PlantError, Record
from rtid.output_error.program import Program, compiled
from rtid.output_error.run import free_run, play

MOST_SUB_STEPS = 64
STEP_ERROR = 1e-3  # of the outputs' standard deviation: what halving the step may change


@dataclass(frozen=True)
class Simulator:
    """Free runs of a plant over the instants and inputs of a record; sub_steps per usual sample."""

    plant: Plant
    record: Record
    sub_steps: int = 1

    @cached_property
    def program(self) -> Program:
        """The plant's equations as instructions."""
        return compiled(self.plant)

    @cached_property
    def first_order(self) -> FloatArray:
        """1 for every input that is linear between samples, else 0."""
        return np.array([float(i.hold == FIRST_ORDER) for i in self.plant.inputs])

    def run(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outputs (n, outputs, lanes) and states (n, states, lanes); NaN where a run diverges.

        values (unknowns, lanes): parameters, then initial values, in the order of
        `plant.unknowns`.
        """
        plant, program, record = self.plant, self.program, self.record
        n_parameters, lanes = len(plant.parameters), values.shape[1]
        first = len(plant.states) + len(plant.inputs)
        r = np.zeros((program.registers, lanes))
        r[first : first + n_parameters] = values[:n_parameters]
        last = program.first_number + len(program.numbers)
        r[program.first_number : last] = program.numbers[:, None]
        u = np.ascontiguousarray(record.u)
        total = np.zeros_like(u)
        total[1:] = np.cumsum(u[:-1] * np.diff(record.t_s)[:, None], axis=0)
        y = np.empty((len(record.t_s), len(plant.outputs), lanes))
        states = np.empty((len(record.t_s), len(plant.states), lanes))
        free_run(
            program.rate_code,
            program.rates,
            program.output_code,
            program.outputs,
            r,
            self._initial(values),
            record.t_s,
            u,
            total,
            self.first_order,
            self._delays(values),
            float(np.median(np.diff(record.t_s))) / self.sub_steps,
            y,
            states,
        )
        return self._played(y, values), states

    def _initial(self, values: FloatArray) -> FloatArray:
        """States at the first sample (states, lanes)."""
        x = np.empty((len(self.plant.states), values.shape[1]))
        names = [i.name for i in self.plant.inputs]
        free = iter(values[len(self.plant.parameters) :])
        for row, state in zip(x, self.plant.states, strict=True):
            row[:] = self.record.u[0, names.index(state.follows)] if state.follows else next(free)
        return x

    def _of(self, values: FloatArray, name: str) -> FloatArray:
        index = [p.name for p in self.plant.parameters].index(name)
        return np.asarray(values[index])

    def _delays(self, values: FloatArray) -> FloatArray:
        found = np.zeros((len(self.plant.inputs), values.shape[1]))
        for row, given in zip(found, self.plant.inputs, strict=True):
            if given.delay:
                row[:] = self._of(values, given.delay)
        return found

    def _played(self, y: FloatArray, values: FloatArray) -> FloatArray:
        for o, output in enumerate(self.plant.outputs):
            if output.play:
                _behind_gap(y[:, o], self._of(values, output.play))
        return y


def _behind_gap(z: FloatArray, width: FloatArray) -> None:
    """Move every lane of z (n, lanes) behind its gap, in place."""
    for j in range(z.shape[1]):
        moved = np.empty(len(z))
        play(np.ascontiguousarray(z[:, j]), max(float(width[j]), 0.0), moved)
        z[:, j] = moved


def resolved(plant: Plant, record: Record, values: FloatArray, least: int = 1) -> Simulator:
    """The simulator whose step is small enough at these values (unknowns,).

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


def _outputs(plant: Plant, record: Record, values: FloatArray, sub_steps: int) -> FloatArray:
    return Simulator(plant, record, sub_steps).run(values[:, None])[0][:, :, 0]
