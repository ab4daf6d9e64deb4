"""Refits by output error from files: the equations in a TOML file, the record in a table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge.sources.table import Table, read_table
from rtid.effects.tree import FloatArray
from rtid.output_error.diagnosis import Diagnosis, diagnose
from rtid.output_error.model import Key, Model, refit
from rtid.output_error.plant import PlantError, Record
from rtid.output_error.validation import on_record, rms
from rtid.plantfile import PlantFile

FEWEST_ROWS = 20


@dataclass(frozen=True)
class Records:
    """The identification part, and the validation part if there is one."""

    identification: Record
    validation: Record | None
    same_start: bool


@dataclass(frozen=True)
class Refitted:
    """What `rtid refit` has found: the plant as given, with what was added, and the diagnosis."""

    file: PlantFile
    records: Records
    first: Model
    last: Model
    diagnosis: Diagnosis | None

    def errors(self, model: Model) -> dict[str, FloatArray]:
        """Root mean square of the free run's error per part, (outputs,)."""
        found = {"identification": model.fit.rmse}
        if self.records.validation is not None:
            same = self.records.same_start
            found["validation"] = rms(
                on_record(model.fit, self.records.validation, same_start=same)
            )
        return found


def load_records(file: PlantFile, table: str | Path) -> Records:
    """The parts of the record in a table.  Raises LogError, PlantError."""
    read = read_table(table)
    t = read.column(file.time_column)
    n_inputs = len(file.plant.inputs)
    whole = _record(read, t, file.columns, n_inputs)
    if file.validation_columns:
        other = _record(read, t, file.validation_columns, n_inputs)
        return Records(whole, other, file.same_start)
    if file.from_s is None:
        return Records(whole, None, file.same_start)
    later = whole.t_s >= file.from_s
    if later.sum() < FEWEST_ROWS or (~later).sum() < FEWEST_ROWS:
        span = f"{whole.t_s[0]:g} to {whole.t_s[-1]:g} s"
        remedy = f"the record goes from {span}; correct validation.from_s in {file.path}"
        raise PlantError(f"{file.from_s:g} s leaves too few rows on one side", remedy)
    return Records(_cut(whole, ~later), _cut(whole, later), file.same_start)


def run(
    file: PlantFile,
    records: Records,
    add: tuple[Key, ...] = (),
    *,
    with_diagnosis: bool = False,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> Refitted:
    """Fit the plant, add effects, and diagnose what it misses beyond them.  Raises PlantError."""
    first = last = refit(file.plant, records.identification)
    if add:
        last = refit(file.plant, records.identification, add)
    found = None
    if with_diagnosis:
        found = diagnose(file.plant, records.identification, progress, add)
        last = found.last
    return Refitted(file, records, first, last, found)


def _cut(record: Record, rows: Any) -> Record:
    return Record(record.t_s[rows], record.u[rows], record.y[rows])


def _record(table: Table, t: FloatArray, columns: tuple[str, ...], n_inputs: int) -> Record:
    """Rows that have a time; columns may be of different length in a table of two records."""
    values = np.column_stack([table.column(name) for name in columns])
    rows = np.isfinite(t) & np.isfinite(values).any(axis=1)
    if rows.sum() < FEWEST_ROWS:
        remedy = "name the columns of the record"
        raise PlantError(f"{table.path}: fewer than {FEWEST_ROWS} rows with numbers", remedy)
    return Record(t[rows], values[rows, :n_inputs], values[rows, n_inputs:])
