"""One section of the file at a time: keys with units to SI fields, then pydantic, all errors kept.

A section that fails returns None and its problems, so that the other sections are judged as well.
Paths are those of the file: `edges.pa.dp_grid_mpa[3]`, whatever the field is called inside.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, TypeVar, get_args, get_origin

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from rtid.project.errors import Problem
from rtid.project.schema import Dimension, Section
from rtid.units import Unit, nearest, units_of

Raw = dict[str, Any]
LARGEST = 1e30  # of any number in a project file, in SI; its inverse is the smallest
ABSURD = f"the number is larger than {LARGEST:g} or smaller than {1 / LARGEST:g}, in SI"
S = TypeVar("S", bound=Section)


def read_section(kind: type[S], raw: Any, path: str) -> tuple[S | None, list[Problem]]:
    """Validate one table of the file; None if it has any problem."""
    if not isinstance(raw, dict):
        return None, [Problem(path, "must be a table", f"write [{path}] and its keys below")]
    values, keys, problems = _to_si(kind, raw, path)
    try:
        section = kind.model_validate(values)
    except ValidationError as error:
        details = error.errors(include_url=False)
        return None, problems + _explain(kind, raw, keys, details, path, problems)
    return (section, []) if not problems else (None, problems)


def key_of(raw: Raw, stem: str) -> str:
    """The key under which the quantity `stem` ("dp_grid") stands in the file, else the stem."""
    return next((key for key in raw if key == stem or key.rpartition("_")[0] == stem), stem)


def quantities(kind: type[Section]) -> dict[str, tuple[str, Dimension]]:
    """Fields that are quantities: stem of the key -> (field name, dimension)."""
    by_name = {}
    for name, field in kind.model_fields.items():
        for mark in field.metadata:
            if isinstance(mark, Dimension):
                by_name[name.rpartition("_")[0]] = (name, mark)
    return by_name


def _to_si(kind: type[Section], raw: Raw, path: str) -> tuple[Raw, dict[str, str], list[Problem]]:
    """Values by field in SI, the key of each field, and the keys that fit no field."""
    values: Raw = {}
    keys: dict[str, str] = {}
    problems: list[Problem] = []
    for key, value in raw.items():
        field, factor, remedy = _match(kind, key)
        if field is None:
            what = "unit missing or wrong" if remedy.startswith("write") else "unknown key"
            problems.append(Problem(_join(path, key), what, remedy))
        elif field in values:
            problems.append(
                Problem(_join(path, key), f"given twice, also as {keys[field]}", "keep one")
            )
        elif (inner := _nested(kind, field)) is not None:
            section, more = read_section(inner, value, _join(path, key))
            problems += more
            values |= {field: section} if section is not None else {}
        else:
            values[field], keys[field] = _scaled(value, factor), key
            if any(_is_absurd(number) for number in _numbers(values[field])):
                problems.append(Problem(_join(path, key), ABSURD, "check number and unit"))
    return values, keys, problems


def _numbers(value: Any) -> Iterator[float]:
    """Every number in a value, in lists and tables too."""
    if isinstance(value, list | dict):
        for entry in value.values() if isinstance(value, dict) else value:
            yield from _numbers(entry)
    elif isinstance(value, int | float):
        yield value


def _is_absurd(number: float) -> bool:
    """Too large or too small for its square to mean anything; inf and nan are refused by pydantic.

    A rated pressure of 5e305 Pa passed every other check, and ended in a covariance of NaN.
    """
    return 0 < abs(number) < 1 / LARGEST or LARGEST < abs(number) < math.inf


def _nested(kind: type[Section], field: str) -> type[Section] | None:
    """The section type of a field that is a section itself, e.g. [dynamics.spool_lag]."""
    annotation = kind.model_fields[field].annotation
    if get_origin(annotation) is dict:
        return None
    for choice in (annotation, *get_args(annotation)):
        if isinstance(choice, type) and issubclass(choice, Section):
            return choice
    return None


def _match(kind: type[Section], key: str) -> tuple[str | None, float, str]:
    """Field and factor for a key, or None and the remedy."""
    known = quantities(kind)
    stem, _, suffix = key.rpartition("_")
    if stem in known:
        field, dimension = known[stem]
        unit = next((u for u in units_of(dimension.name) if u.key == suffix), None)
        return (field, unit.factor, "") if unit else (None, 1.0, _spelled(stem, dimension))
    if key in known:
        return None, 1.0, _spelled(key, known[key][1])
    plain = [name for name in kind.model_fields if name.rpartition("_")[0] not in known]
    if key in plain:
        return key, 1.0, ""
    spelled = [f"{s}_{u.key}" for s, (_, d) in known.items() for u in units_of(d.name)]
    fields = [name for name in kind.model_fields if name not in plain] + plain
    guess = nearest(key, plain + spelled)
    return None, 1.0, guess if guess.startswith("did") else nearest(key, fields)


def _spelled(stem: str, dimension: Dimension) -> str:
    keys: list[Unit] = list(units_of(dimension.name))
    return "write " + " or ".join(f"{stem}_{unit.key}" for unit in keys)


def _scaled(value: Any, factor: float) -> Any:
    """The number, or every number inside a list or table, times factor; the rest untouched."""
    if isinstance(value, list):
        return [_scaled(entry, factor) for entry in value]
    if isinstance(value, dict):
        return {key: _scaled(entry, factor) for key, entry in value.items()}
    if factor == 1.0 or isinstance(value, bool) or not isinstance(value, int | float):
        return value
    return value * factor


def _join(path: str, key: object) -> str:
    if isinstance(key, int):
        return f"{path}[{key}]"
    return f"{path}.{key}" if path else str(key)


def _explain(
    kind: type[Section],
    raw: Raw,
    keys: dict[str, str],
    details: list[ErrorDetails],
    path: str,
    known: list[Problem],
) -> list[Problem]:
    """Pydantic's errors in our words; one per place; none for a key that is already named."""
    problems: dict[str, Problem] = {}
    for error in details:
        field = str(error["loc"][0])
        stem = field.rpartition("_")[0]
        named = any(p.path.startswith(_join(path, stem)) for p in known if stem)
        if error["type"] == "missing" and named:
            continue
        problem = _problem(kind, raw, keys, error, path)
        problems.setdefault(problem.path, problem)
    return list(problems.values())


def _problem(
    kind: type[Section], raw: Raw, keys: dict[str, str], error: ErrorDetails, path: str
) -> Problem:
    field = str(error["loc"][0])
    hint = kind.model_fields[field].description if field in kind.model_fields else None
    if error["type"] == "missing":
        key = (hint or field).partition(" ")[0]  # with a unit, as the file would have it
        key = key if key.startswith(field.rpartition("_")[0]) else field
        return Problem(_join(path, key), "missing", f"add {hint or field}")
    place, value = _join(path, keys.get(field, field)), raw.get(keys.get(field, field))
    context = error.get("ctx", {})
    inner: list[Any] = [*error["loc"][1:], *([context["index"]] if "index" in context else [])]
    for step in inner:
        if isinstance(value, dict | list) and _has(value, step):
            value, place = value[step], _join(place, step)
    text = error["msg"][0].lower() + error["msg"][1:]
    shown = "" if isinstance(value, dict | list) else f", is {value!r}"
    return Problem(place, _reworded(text) + shown, _remedy(error["type"], hint))


def _has(value: dict[str, Any] | list[Any], step: object) -> bool:
    if isinstance(value, list):
        return isinstance(step, int) and step < len(value)
    return step in value


def _reworded(text: str) -> str:
    return text.replace("input should", "must")


def _remedy(error_type: str, hint: str | None) -> str:
    by_type = {
        "greater_than": "check number and unit",
        "greater_than_equal": "check number and unit",
        "grid": "list the borders from low to high, or as {start = 1, stop = 4, step = 0.25}",
        "order": "write [low, high]",
        "literal_error": "choose one of these",
        "float_type": "write a number without quotes",
        "string_type": "write a text in quotes",
    }
    return f"write {hint}" if hint else by_type.get(error_type, "correct the value")
