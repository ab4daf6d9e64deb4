"""Plant files: a plant by its equations in TOML, and where a table holds its record.

    [plant], [inputs.NAME], [states.NAME], [outputs.NAME], [parameters.NAME], [validation]

See `rtid/project/examples/cascaded_tanks.toml`.  Every problem is named by its key path.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from rtid.effects import Expression, ExpressionError
from rtid.effects.tree import Node, named
from rtid.errors import door
from rtid.plants.plant import Input, Output, Plant, PlantParameter, PlantState
from rtid.project.errors import Problem, ProjectError
from rtid.project.schema import Section
from rtid.project.sections import Raw, read_section
from rtid.units import nearest


class PlantSection(Section):
    """[plant]: what it is called, and the column of the time (s, or what its name says: t_ms)."""

    name: str = Field(min_length=1, description='name = "cascaded tanks"')
    time_column: str = "t"


class InputSection(Section):
    """[inputs.NAME]: its columns; "zero": it is held until the next sample, "first": linear."""

    column: str = Field(description='column = "u"')
    validation_column: str | None = None
    unit: str = ""
    hold: Literal["zero", "first"] = "zero"


class StateSection(Section):
    """[states.NAME]: d NAME / dt, and start and bounds of its initial value, which is estimated."""

    rate: str = Field(description='rate = "-k*x + u"')
    start: float = Field(description="start = 0.0")
    low: float | None = None
    high: float | None = None
    unit: str = ""
    quantity: Literal["level", "pressure", "temperature", "velocity", "displacement", "any"] = "any"
    inertia: str = "1"
    ambient: str = "0"


class OutputSection(Section):
    """[outputs.NAME]: what is measured, in which columns, with what noise (1 sigma) if known."""

    value: str = Field(description='value = "x"')
    column: str = Field(description='column = "y"')
    validation_column: str | None = None
    unit: str = ""
    noise: float | None = Field(default=None, gt=0)


class PlantParameterSection(Section):
    """[parameters.NAME]: start and bounds of what is estimated."""

    start: float = Field(description="start = 1.0")
    low: float = Field(description="low = 0.0")
    high: float = Field(description="high = 10.0")
    unit: str = ""


class ValidationSection(Section):
    """[validation]: from when on the record is kept for validation, and how that part begins."""

    from_s: float | None = None
    initial: Literal["same", "estimated"] = "estimated"


NAMED: dict[str, type[Section]] = {
    "inputs": InputSection,
    "states": StateSection,
    "outputs": OutputSection,
    "parameters": PlantParameterSection,
}
SINGLE: dict[str, type[Section]] = {"plant": PlantSection, "validation": ValidationSection}
REQUIRED = ("plant", *NAMED)


@dataclass(frozen=True)
class PlantFile:
    """A plant, and where a table holds its record.

    columns: of the inputs, then of the outputs; units: key path and unit of each, "" if not given.
    """

    path: Path
    plant: Plant
    time_column: str
    columns: tuple[str, ...]
    validation_columns: tuple[str, ...]
    units: tuple[tuple[str, str], ...]
    from_s: float | None
    same_start: bool


@door
def load_plant(path: str | Path) -> PlantFile:
    """Read and check a plant file; ProjectError names every problem."""
    path = Path(path)
    raw = _parse(path)
    parts, problems = _read(raw)
    if not problems:
        problems = list(_judge(parts))
    if problems:
        raise ProjectError(path, problems)
    return _assemble(path, parts)


def _parse(path: Path) -> Raw:
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        problem = Problem("file", "does not exist", "name a plant file, with a section [plant]")
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        problem = Problem("file", f"not valid TOML: {error}", "correct this place first")
    raise ProjectError(path, [problem]) from None


def _read(raw: Raw) -> tuple[dict[str, Any], list[Problem]]:
    known = [*SINGLE, *NAMED]
    problems = [Problem(n, "unknown section", nearest(n, known)) for n in raw if n not in known]
    missing = [name for name in REQUIRED if not raw.get(name)]
    problems += [Problem(n, "missing", f"add a section [{n}]") for n in missing]
    parts: dict[str, Any] = {"validation": ValidationSection()}
    for name, kind in SINGLE.items():
        if name in raw:
            parts[name], result = read_section(kind, raw[name], name)
            problems += result
    for name, kind in NAMED.items():
        tables = raw.get(name, {})
        if not isinstance(tables, dict):
            problems.append(Problem(name, "must hold tables", f"write [{name}.NAME]"))
            continue
        parts[name] = {}
        for key, value in tables.items():
            parts[name][key], result = read_section(kind, value, f"{name}.{key}")
            problems += result
    return parts, problems


def _judge(parts: dict[str, Any]) -> Iterator[Problem]:
    """Names given twice, expressions that cannot be read, bounds, halves of a validation."""
    names = [n for kind in ("inputs", "states", "parameters") for n in parts[kind]]
    for name in {n for n in names if names.count(n) > 1}:
        yield Problem(name, "the name is given twice", "rename one of them")
    for path, text in _expressions(parts):
        try:
            Expression.parse(text, names)
        except ExpressionError as error:
            yield Problem(path, error.in_one_line, error.remedy)
    for kind in ("states", "parameters"):
        for name, section in parts[kind].items():
            low = -np.inf if section.low is None else section.low
            high = np.inf if section.high is None else section.high
            if not (low < high and low <= section.start <= high):
                yield Problem(
                    f"{kind}.{name}", "start is not between low and high", "low <= start <= high"
                )
    signals = {f"{k}.{n}": s for k in ("inputs", "outputs") for n, s in parts[k].items()}
    given = {path for path, s in signals.items() if s.validation_column is not None}
    for path in sorted(set(signals) - given if given else ()):
        yield Problem(f"{path}.validation_column", "missing", "give it to all signals or to none")
    if given and parts["validation"].from_s is not None:
        remedy = "keep the columns or the time"
        yield Problem("validation.from_s", "there are validation columns as well", remedy)


def _expressions(parts: dict[str, Any]) -> list[tuple[str, str]]:
    expressions = [(f"outputs.{n}.value", s.value) for n, s in parts["outputs"].items()]
    for name, section in parts["states"].items():
        for key in ("rate", "inertia", "ambient"):
            expressions.append((f"states.{name}.{key}", getattr(section, key)))
    return expressions


def _assemble(path: Path, parts: dict[str, Any]) -> PlantFile:
    names: Collection[str] = [n for k in ("inputs", "states", "parameters") for n in parts[k]]

    def tree(text: str) -> Node:
        return Expression.parse(text, names).root

    states = [
        PlantState(
            name,
            tree(s.rate),
            s.start,
            -np.inf if s.low is None else s.low,
            np.inf if s.high is None else s.high,
            s.unit,
            s.quantity,
            tree(s.inertia),
            tree(s.ambient),
        )
        for name, s in parts["states"].items()
    ]
    inputs = [Input(n, named(n), s.hold, s.unit) for n, s in parts["inputs"].items()]
    outputs = [
        Output(n, tree(s.value), s.unit, np.nan if s.noise is None else s.noise)
        for n, s in parts["outputs"].items()
    ]
    parameters = [
        PlantParameter(n, s.start, s.low, s.high, s.unit) for n, s in parts["parameters"].items()
    ]
    signals = [*parts["inputs"].values(), *parts["outputs"].values()]
    head = parts["plant"]
    plant = Plant(head.name, tuple(states), tuple(inputs), tuple(outputs), tuple(parameters))
    return PlantFile(
        path,
        plant,
        head.time_column,
        tuple(s.column for s in signals),
        tuple(s.validation_column for s in signals if s.validation_column is not None),
        tuple((f"{k}.{n}", s.unit) for k in ("inputs", "outputs") for n, s in parts[k].items()),
        parts["validation"].from_s,
        parts["validation"].initial == "same",
    )
