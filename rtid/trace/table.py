"""Tables as traces: their time, and whether their units are the project's.

The names of the columns and their units are read by `rtid.units.split_name`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from firmware_bridge.config import Assembly
from firmware_bridge.sources.table import TIME_NAMES, Table, is_time
from rtid.errors import RtidError
from rtid.project.guess import unit_said
from rtid.project.project import Project
from rtid.project.schema import SourceSection
from rtid.units import Unit, find_unit, said, split_name


def declared(project: Project, table: Table) -> tuple[Table, Assembly]:
    """The table with the project's time column as `t`, and which column plays which role.

    Raises LogError, and RtidError for a project without columns, or for a column whose unit is not
    the project's.
    """
    assembly = project.table_assembly
    if assembly is None:
        remedy = 'add column = "..." to every signal, or give a CAN log'
        raise RtidError(f"{table.path} is a table, but the project names no columns", remedy)
    declared_units = {s.column: s.unit for s in project.sections.signals.values() if s.column}
    table = _in_units(table, declared_units)
    for name, signal in project.sections.signals.items():
        # a scale that is given insists, as it does against a DBC
        if signal.column and signal.constant is None and signal.scale is None:
            insist = "give scale = 1.0 to insist"
            refuse_other_unit(table, signal.column, signal.unit or "", f"signals.{name}", insist)
    return _with_time(table, project.sections.source), assembly


def _in_units(table: Table, units: Mapping[str, str | None]) -> Table:
    """The table with x_cm, wanted in cm, from its x_mm: a logger's names move with their units."""
    columns = dict(table.columns)
    for wanted, unit in units.items():
        (stem, written), meant = split_name(wanted), find_unit(unit or "")
        if wanted in columns or meant is None or find_unit(written) != meant:
            continue
        for name, values in table.columns.items():
            there = find_unit(split_name(name)[1])
            if there and there.dimension == meant.dimension and split_name(name)[0] == stem:
                in_si = there.factor * values + there.offset
                columns[wanted] = (in_si - meant.offset) / meant.factor
    return replace(table, columns=columns)


def _with_time(table: Table, source: SourceSection) -> Table:
    """The table with the column that the project names as `t`, if it names one."""
    if source.time_column is None:
        return table
    time = table.known_as(source.time_column)
    unit = table.time_unit(time)
    if "time_unit" in source.model_fields_set:
        unit = source.time_unit
    others = {name: column for name, column in table.columns.items() if name != "t"}
    columns = {"t": table.columns[time], **others}
    return replace(table, columns=columns, units=table.units | {"t": unit})


def time_of(table: Table) -> tuple[str, str]:
    """The column that looks like time, and its unit.  Raises RtidError, LogError."""
    name = table.time_name()
    if name is None:
        written = next((title for title in table.unread if is_time(title)), None)
        if written is not None:
            raise RtidError(
                f"{table.path}: {written}: {table.unread[written]} and no time that is known",
                "write seconds, or 14:05:09.250, with or without a date, 2026-03-01, before it",
            )
        raise RtidError(
            f"{table.path}: no column looks like time; it has {', '.join(table.columns)}"
            f"{table.unread_said}",
            f"call it one of {', '.join(TIME_NAMES)}, with its unit behind: t_ms; the names stand "
            "in one line, right above the numbers or above one of units",
        )
    table.seconds(name)  # refuses a unit that is none of time
    return name, said(table.time_unit(name)) or "s"


def refuse_other_unit(
    table: Table, column: str, unit: str, where: str, insist: str = "rename the column"
) -> None:
    """RtidError where a file says, or a column's name, that it is in another unit than `unit`."""
    meant, declared = unit_of_column(table, column), find_unit(unit)
    if meant is None or declared is None or meant == declared:
        return
    raise RtidError(
        f"{table.path}: column {column!r} is in {meant.name}, {where}.unit says {declared.name}",
        f'set {where}.unit = "{meant.name}", or {insist}',
    )


def unit_of_column(table: Table, column: str) -> Unit | None:
    """Unit of a column as the file or its name tells; None if neither does."""
    name = table.known_as(column)
    return find_unit(unit_said(name, table.units.get(name)))
