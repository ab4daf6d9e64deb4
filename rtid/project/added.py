"""[[added]]: the effects that `rtid add` has made part of the model, and their text in the file.

    [[added]]
    effect = "NAME"
    where = "a-b"
    date = 2026-03-01T09:30:00Z
    ...
    [added.parameters.coefficient]
    value = 5.8e-12
    sd = 2e-13
    unit = "m3/s/Pa"

Everything else in the file, comments above all, stays as the user has written it.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

import tomlkit
from pydantic import Field
from tomlkit import TOMLDocument
from tomlkit.items import InlineTable, Table

from rtid.project.errors import Problem
from rtid.project.schema import Section
from rtid.project.sections import Raw, read_section


class ParameterSection(Section):
    """One parameter of an added effect, SI; sd: of a fitted one."""

    value: float = Field(description="value = 5.8e-12")
    sd: float | None = Field(default=None, ge=0)
    unit: str = Field(description='unit = "m3/s/Pa"')


class ChangeSection(Section):
    """A figure without and with the effect; not given where nothing could be judged."""

    before: float | None = Field(default=None, ge=0)
    after: float | None = Field(default=None, ge=0)


class ErrorsSection(Section):
    """[added.errors]: root mean square residuals behind H_f, also in per cent of the rms flow.

    rho: residual variance of the identification part, of the sensors' noise; judged_s: of the
    held-out part, where the map is known well enough.
    """

    rho: ChangeSection = ChangeSection()
    identification_m3s: ChangeSection = ChangeSection()
    identification_pct: ChangeSection = ChangeSection()
    heldout_m3s: ChangeSection = ChangeSection()
    heldout_pct: ChangeSection = ChangeSection()
    noise_floor_m3s: float | None = Field(default=None, ge=0)
    noise_floor_pct: float | None = Field(default=None, ge=0)
    judged_s: float | None = Field(default=None, ge=0)


class AddedSection(Section):
    """[[added]]: an effect that is part of the model, with what it was found with."""

    effect: str = Field(min_length=1, description='effect = "NAME", as `rtid effects` lists it')
    where: str = Field(description='where = "a-b"')
    own_spools: bool = False
    date: datetime | None = None
    trace: str = ""
    reason: str = ""
    parameters: dict[str, ParameterSection] = Field(
        min_length=1, description='parameters = {coefficient = {value = 5.8e-12, unit = "m3/s/Pa"}}'
    )
    errors: ErrorsSection = ErrorsSection()

    @property
    def key(self) -> tuple[str, str]:
        """Effect and place: what makes it one of a kind in a project."""
        return self.effect, self.where


def read(raw: Any) -> tuple[tuple[AddedSection, ...], list[Problem]]:
    """All of [[added]], and what is wrong with them."""
    if not isinstance(raw, list):
        return (), [Problem("added", "must be a list of tables", "write [[added]]")]
    sections: dict[tuple[str, str], AddedSection] = {}
    problems: list[Problem] = []
    for k, table in enumerate(raw):
        section, more = _read_one(table, f"added[{k}]")
        problems += more
        if section and section.key in sections:
            problems.append(Problem(f"added[{k}]", "is added twice", "keep one"))
        elif section:
            sections[section.key] = section
    return tuple(sections.values()), problems


def _read_one(raw: Any, path: str) -> tuple[AddedSection | None, list[Problem]]:
    """One of them, each parameter judged as a table of its own."""
    tables = raw.get("parameters") if isinstance(raw, dict) else None
    if not isinstance(tables, dict):
        return read_section(AddedSection, raw, path)
    parameters: dict[str, ParameterSection] = {}
    problems: list[Problem] = []
    for name, table in tables.items():
        section, more = read_section(ParameterSection, table, f"{path}.parameters.{name}")
        problems += more
        parameters |= {name: section} if section else {}
    if problems:
        return None, problems
    return read_section(AddedSection, raw | {"parameters": parameters}, path)


def text_with(text: str, sections: tuple[AddedSection, ...]) -> str:
    """The text of a project file with these in the place of those of the same key, or behind all.

    Those that the file has and `sections` has not are taken out.
    """
    document = tomlkit.parse(text)
    wanted = {section.key: section for section in sections}
    there = document.get("added", [])
    for k in reversed(range(len(there))):
        section = wanted.pop((there[k]["effect"], there[k]["where"]), None)
        if section is None:
            del there[k]
        else:
            _update(there[k], section)
    _append(document, list(wanted.values()))
    if "added" in document and not document["added"]:
        del document["added"]
    return tomlkit.dumps(document)


def _update(table: Table, section: AddedSection) -> None:
    """New parameters where they have changed."""
    old = AddedSection.model_validate(table.unwrap())
    if old.parameters != section.parameters:
        table["parameters"] = _table(section)["parameters"]


def _append(document: TOMLDocument, sections: list[AddedSection]) -> None:
    if sections and "added" not in document:
        document["added"] = tomlkit.aot()
    for section in sections:
        table = _table(section)
        table.trivia.indent = "\n"  # an empty line before it
        document["added"].append(table)


def _table(section: AddedSection) -> Table:
    """A section as it stands in the file: a table per parameter, pairs in one line."""
    table = tomlkit.table()
    plain: Raw = section.model_dump(exclude_none=True, exclude_defaults=True)
    parameters, errors = plain.pop("parameters"), plain.pop("errors", {})
    for key, value in plain.items():
        table[key] = value
    outer = tomlkit.table(is_super_table=True)
    for name, values in parameters.items():
        outer[name] = tomlkit.item(values)
    table["parameters"] = outer
    if errors:
        table["errors"] = tomlkit.table()
        for name, value in errors.items():
            table["errors"][name] = _pair(value) if isinstance(value, dict) else value
    return table


def _pair(values: dict[str, float]) -> InlineTable:
    inline = tomlkit.inline_table()
    inline.update(values)
    return inline
