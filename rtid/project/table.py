"""Tables as traces: which files are tables, and the project's own name for the time column."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from firmware_bridge.sources.table import Table, read_table
from rtid.project.project import Project

SUFFIXES = (".parquet", ".csv", ".tsv", ".txt", ".mat")


def is_table(path: Path) -> bool:
    """Whether a file holds columns of signals; a .csv may also be a CAN log of python-can."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return path.suffix.lower() in SUFFIXES
    with path.open(errors="replace") as file:
        return "arbitration_id" not in file.readline()


def open_table(project: Project, path: Path) -> Table:
    """The table, with the project's time column as `t`.  Raises LogError."""
    table, source = read_table(path), project.sections.source
    if source.time_column is None:
        return table
    t = table.column(source.time_column)
    unit = table.units.get(source.time_column, "")
    if "time_unit" in source.model_fields_set:
        unit = source.time_unit
    others = {name: column for name, column in table.columns.items() if name != "t"}
    return replace(table, columns={"t": t, **others}, units=table.units | {"t": unit})
