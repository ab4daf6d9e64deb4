"""The parts of the paper that can be reproduced, in the order of the paper."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper import fig3, fig4, fig5, fig6, hidden, table1
from benchmarks.paper.result import Part, all_met
from rtid.errors import RtidError

PAPER = "IMECE2005-79420"
Progress = Callable[[str, float], None]
Maker = Callable[[int, int], Part]

PARTS: dict[str, Maker] = {  # each is given the seed and the number of random plants
    "fig3": lambda seed, plants: fig3.reproduce(seed),
    "fig4": lambda seed, plants: fig4.reproduce(seed),
    "table1": table1.reproduce,
    "fig5": lambda seed, plants: fig5.reproduce(seed),
    "fig6": fig6.reproduce,
    "hidden": hidden.reproduce,
}
SEED, PLANTS = 0, 30


def chosen(only: str | None) -> list[str]:
    """Keys of a list with commas, all without one.  Raises RtidError, naming those that exist."""
    keys = [key.strip().lower() for key in only.split(",")] if only else list(PARTS)
    for key in keys:
        if key not in PARTS:
            raise RtidError(f"{key}: no such part", f"use {', '.join(PARTS)}", 2)
    return keys


def reproduce(
    folder: Path, keys: Sequence[str], progress: Progress, seed: int = SEED, plants: int = PLANTS
) -> list[Part]:
    """Make the parts; pictures, `paper.md` and `paper.json` go into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    done: list[Part] = []
    for number, key in enumerate(keys):
        progress(f"{key} of the paper", number / len(keys))
        done.append(PARTS[key](seed, plants))
        done[-1].save(folder)
        (folder / "paper.md").write_text(markdown(done), "utf-8")
        (folder / "paper.json").write_text(json.dumps(as_json(done), indent=1) + "\n", "utf-8")
    progress("done", 1.0)
    return done


def markdown(parts: Sequence[Part]) -> str:
    """All parts as one Markdown text."""
    head = f"# {PAPER}, reproduced on a simulated rig\n\nWritten by `make paper`.\n"
    return "\n".join([head, *(part.markdown() for part in parts)])


def as_json(parts: Sequence[Part]) -> dict[str, Any]:
    """All parts for machines."""
    return {"paper": PAPER, "all_met": all_met(parts), "parts": [p.as_json() for p in parts]}
