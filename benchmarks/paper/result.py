"""One reproduced figure or table: numbers beside the paper's and the goals, a table, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from rtid.tell.stills import save

SUFFIXES = ("png", "svg")


@dataclass(frozen=True)
class Measure:
    """One number that was reached; paper: what the paper reports, goal: what is asked, in words.

    met: whether the goal is reached, None where there is none.
    """

    name: str
    value: float
    unit: str = ""
    paper: str = ""
    goal: str = ""
    met: bool | None = None

    @property
    def text(self) -> str:
        """Value and unit, three digits, whole numbers as they are."""
        whole = float(self.value).is_integer()
        return f"{self.value:{'.0f' if whole else '.3g'}} {self.unit}".rstrip()


def at_most(name: str, value: float, limit: float, unit: str = "", paper: str = "") -> Measure:
    """A measure that must not exceed a limit."""
    goal = f"at most {limit:g} {unit}".rstrip()
    return Measure(name, float(value), unit, paper, goal, bool(value <= limit))


def at_least(name: str, value: float, limit: float, unit: str = "", paper: str = "") -> Measure:
    """A measure that must reach a limit."""
    goal = f"at least {limit:.3g} {unit}".rstrip()
    return Measure(name, float(value), unit, paper, goal, bool(value >= limit))


@dataclass(frozen=True)
class Table:
    """A titled table of texts."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """As Markdown."""
        lines = [self.head, ("---",) * len(self.head), *self.rows]
        return f"{self.title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines)


@dataclass(frozen=True)
class Part:
    """A figure or table of the paper: key for `--only`, title, what was done in a few sentences."""

    key: str
    title: str
    text: str
    measures: tuple[Measure, ...]
    tables: tuple[Table, ...] = ()
    pictures: dict[str, Figure] = field(default_factory=dict)

    def measure(self, name: str) -> Measure:
        """The measure with this name."""
        return next(m for m in self.measures if m.name == name)

    def save(self, folder: Path) -> list[Path]:
        """Write the pictures as PNG and SVG; their paths."""
        return [
            save(figure, folder / f"{name}.{suffix}")
            for name, figure in self.pictures.items()
            for suffix in SUFFIXES
        ]

    def markdown(self) -> str:
        """Title, text, numbers beside the paper's, tables, pictures."""
        words = {True: "yes", False: "**no**", None: ""}
        rows = tuple((m.name, m.text, m.paper, m.goal, words[m.met]) for m in self.measures)
        numbers = Table("", ("", "here", "paper", "goal", "reached"), rows).markdown().strip()
        pictures = [f"![{self.title}]({name}.png)" for name in self.pictures]
        tables = [table.markdown() for table in self.tables]
        return "\n\n".join([f"## {self.title}", self.text, numbers, *tables, *pictures]) + "\n"

    def as_json(self) -> dict[str, Any]:
        """The same for machines."""
        return {
            "key": self.key,
            "title": self.title,
            "text": self.text,
            "measures": [vars(m) for m in self.measures],
            "tables": [vars(t) for t in self.tables],
            "pictures": [f"{n}.{s}" for n in self.pictures for s in SUFFIXES],
        }


def all_met(parts: Sequence[Part]) -> bool:
    """Whether every goal of every part is reached."""
    return all(m.met is not False for part in parts for m in part.measures)
