"""A table of a plant by its equations, looked at without a project file: in words and as JSON."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rtid.study.quick_plant import QuickPlant
from rtid.tell.refit import as_json, sentences

SCHEMA = 1


def plant_lines(quick: QuickPlant, saved: Path | None = None) -> Iterator[str]:
    """What it was taken as, its equations, how far their free run is off, what they miss."""
    found = quick.found
    yield f"{quick.path.name}, without a project file: {found.structure.words}."
    for role, candidate in found.pair.roles.items():
        yield f"  {role:9} {candidate.full_name} [{candidate.unit or '?'}]"
    if judges := found.record.others:
        yield f"A second record is in the table, and judges: {' and '.join(judges)}."
    if quick.unused:
        yield f"Not used: {', '.join(quick.unused)}"
    yield "What the command moves does not stand where it is left: no map of a rate serves it."
    for state, rate in found.structure.rates.items():
        yield f"  d {state} / dt = {rate}"
    yield ""
    yield from sentences(quick.refitted)
    yield ""
    if saved is not None:
        yield f"wrote {saved}"
        yield f"Next: {quick.after(saved)}"
        return
    yield f"Next: {quick.next_command}"
    yield "  writes the plant file, whose equations are yours to change."


def plant_json(quick: QuickPlant, saved: Path | None = None) -> dict[str, Any]:
    """Plain JSON types: what `rtid refit --json` gives, and what the table was taken as."""
    return {
        "schema": SCHEMA,
        "file": str(quick.path),
        "plant": "equations",
        "kind": quick.found.structure.words,
        "roles": {role: asdict(candidate) for role, candidate in quick.found.pair.roles.items()},
        "judges": quick.found.record.others,
        "unused": list(quick.unused),
        "refit": as_json(quick.refitted),
        "next": quick.after(saved) if saved else quick.next_command,
    }
