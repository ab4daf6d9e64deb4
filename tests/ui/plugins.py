"""A package of a user's own, installed as far as entry points are concerned."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

EXTENDING = Path(__file__).parents[2] / "docs" / "extending.md"


def snippet(heading: str, language: str) -> str:
    """The one snippet of a section of docs/extending.md."""
    section = EXTENDING.read_text().partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    (code,) = re.findall(rf"^```{language}\n(.*?)^```", section, re.M | re.S)
    return str(code)


def install(folder: Path, module: str, code: str, entries: str, patch: pytest.MonkeyPatch) -> None:
    """Have a module found, with the lines of its entry_points.txt."""
    (folder / f"{module}.py").write_text(code)
    info = folder / f"{module}-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1\n")
    (info / "entry_points.txt").write_text(entries)
    patch.syspath_prepend(str(folder))
