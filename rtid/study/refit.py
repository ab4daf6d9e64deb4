"""Refits by output error from files: the equations in a TOML file, the record in a table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge.sources import read_table
from firmware_bridge.sources.table import Table
from rtid.plain import FloatArray, Key, Progress, silent
from rtid.plants.fitted import PlantModel, refit
from rtid.plants.missing import PlantDiagnosis, diagnose
from rtid.plants.plant import PlantError, PlantRecord
from rtid.plants.validation import on_record, rms
from rtid.project.plant_file import PlantFile
from rtid.trace.table import refuse_other_unit

FEWEST_ROWS = 20  # of a record, and of each part between its gaps


@dataclass(frozen=True)
class Records:
    """The identification part, and the validation part if there is one.

    left_out: times (from, to) of rows between two gaps that were too few to be used, s.
    """

    identification: PlantRecord
    validation: PlantRecord | None
    same_start: bool
    left_out: tuple[tuple[float, float], ...] = ()

    @property
    def named(self) -> list[tuple[str, PlantRecord]]:
        """The parts that there are, by name."""
        parts = [("identification", self.identification), ("validation", self.validation)]
        return [(name, record) for name, record in parts if record is not None]

    def unseen(self, model: PlantModel) -> FloatArray:
        """Root mean square of the free run's error (outputs,), in their units, for validation."""
        assert self.validation is not None, "asked only where there is one"
        return rms(on_record(model.fit, self.validation, same_start=self.same_start))


@dataclass(frozen=True)
class Refitted:
    """What `rtid refit` has found: the plant as given, with what was added, and the diagnosis."""

    file: PlantFile
    records: Records
    first: PlantModel
    last: PlantModel
    diagnosis: PlantDiagnosis | None

    def errors(self, model: PlantModel) -> dict[str, FloatArray]:
        """Root mean square of the free run's error per part, (outputs,), in their units."""
        errors_of = {"identification": model.fit.rmse}
        if self.records.validation is not None:
            errors_of["validation"] = self.records.unseen(model)
        return errors_of


def load_records(file: PlantFile, table: str | Path) -> Records:
    """The parts of the record in a table.

    Raises LogError, PlantError, and RtidError for a column in another unit than the plant's.
    """
    read = read_table(table)
    t = read.seconds(file.time_column)
    for columns in (file.columns, file.validation_columns):
        for column, (where, unit) in zip(columns, file.units, strict=False):
            refuse_other_unit(read, column, unit, where)
    n_inputs = len(file.plant.inputs)
    whole, left_out = _record(read, t, file.columns, n_inputs)
    if file.validation_columns:
        other, more = _record(read, t, file.validation_columns, n_inputs)
        return Records(whole, other, file.same_start, left_out + more)
    if file.from_s is None:
        return Records(whole, None, file.same_start, left_out)
    later = whole.t_s >= file.from_s
    if later.sum() < FEWEST_ROWS or (~later).sum() < FEWEST_ROWS:
        span = f"{whole.t_s[0]:g} to {whole.t_s[-1]:g} s"
        remedy = f"the record goes from {span}; correct validation.from_s in {file.path}"
        raise PlantError(f"{file.from_s:g} s leaves too few rows on one side", remedy)
    return Records(_cut(whole, ~later), _cut(whole, later), file.same_start, left_out)


def run(
    file: PlantFile,
    records: Records,
    add: tuple[Key, ...] = (),
    *,
    with_diagnosis: bool = False,
    with_limits: bool = True,
    progress: Progress = silent,
) -> Refitted:
    """Fit the plant, add effects, and diagnose what it misses beyond them.  Raises PlantError.

    with_limits: the smallest size of what was not found is looked for as well.
    """
    progress("fitting", 0.0)
    first = last = refit(file.plant, records.identification)
    if add:
        progress("adding effects", 0.05)
        last = refit(file.plant, records.identification, add)
    diagnosis = None
    if with_diagnosis:
        unseen = records.unseen if records.validation is not None else None
        diagnosis = diagnose(
            file.plant, records.identification, progress, add, unseen, with_limits=with_limits
        )
        last = diagnosis.last
    return Refitted(file, records, first, last, diagnosis)


def _cut(record: PlantRecord, rows: Any) -> PlantRecord:
    return PlantRecord(record.t_s[rows], record.u[rows], record.y[rows])


def _record(
    table: Table, t: FloatArray, columns: tuple[str, ...], n_inputs: int
) -> tuple[PlantRecord, tuple[tuple[float, float], ...]]:
    """Rows that have a time, and where too few stand between two gaps to be of use.

    Columns may be of different length in a table of two records.
    """
    values = np.column_stack([table.column(name) for name in columns])
    rows = np.isfinite(t) & np.isfinite(values).any(axis=1)
    if rows.sum() < FEWEST_ROWS:
        remedy = "name the columns of the record"
        raise PlantError(f"{table.path}: fewer than {FEWEST_ROWS} rows with numbers", remedy)
    whole = PlantRecord(t[rows], values[rows, :n_inputs], values[rows, n_inputs:])
    ends = np.append(whole.starts, len(whole.t_s))
    long_enough = np.diff(ends) >= FEWEST_ROWS
    if not long_enough.any():
        remedy = "give a record that was taken without pauses"
        raise PlantError(f"{table.path}: fewer than {FEWEST_ROWS} rows between its gaps", remedy)
    short = [k for k, enough in enumerate(long_enough) if not enough]
    left_out = tuple((float(whole.t_s[ends[k]]), float(whole.t_s[ends[k + 1] - 1])) for k in short)
    return _cut(whole, np.repeat(long_enough, np.diff(ends))), left_out
