"""What is wrong with a project file: every problem at once, each with place and remedy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rtid.errors import RtidError


@dataclass(frozen=True)
class Problem:
    """One error: key path as written in the file, what is wrong, what to do about it."""

    path: str
    problem: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.path}: {self.problem}; {self.remedy}"


class ProjectError(RtidError):
    """The project file cannot be used; `problems` names everything that is wrong with it."""

    exit_code = 2

    def __init__(self, file: Path, problems: list[Problem]) -> None:
        self.file = file
        self.problems = problems
        count = f"{len(problems)} problem{'s' if len(problems) != 1 else ''}"
        lines = "\n".join(f"  {problem}" for problem in problems)
        super().__init__(f"{file}: {count} in the project file\n{lines}")
