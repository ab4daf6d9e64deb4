"""Changes of a model as a user reads them: sentences, bars of the error, the table of history."""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import nan
from typing import Any

from rtid.diagnose.report import Value
from rtid.effects.page import title
from rtid.project.history import ADD, UNDO, Change
from rtid.study.revisions import Revised, undo_command
from rtid.tell.diagnosed import with_convention
from rtid.tell.history import SCHEMA, plain
from rtid.tell.story import Bar, Bars
from rtid.tell.terminal import bars, make_console
from rtid.tell.words import is_floor, quantity


def show(done: Revised, is_json: bool = False, **more: str) -> None:
    """Print what a command did, or would do; as JSON with more of the command's own."""
    if is_json:
        print(json.dumps(more | as_json(done)))
        return
    console = make_console()
    lines = [line for change in done.changes for line in sentences(change, done.is_written)]
    for line in with_convention(lines):
        console.print(line)
    if done.note:
        console.print(done.note)
    if done.is_written:
        back = f"; `{undo_command(done.project)}` takes it back"
        said = f"wrote {done.project}" + ("" if done.changes[-1].change == UNDO else back)
        console.print(said, soft_wrap=True)  # a command that is broken is not pasted
    else:
        console.print(f"{done.project} is as it was: a trial", soft_wrap=True)


def sentences(change: Change, is_written: bool = True) -> list[str]:
    """One change in plain words, with bars of the held-out error where it was judged."""
    verb = "is" if is_written else "would be"
    name = f"{title(change.effect)} at {change.where}"
    if change.change == UNDO:
        return [f"Change {change.undoes} is taken back: {name}."]
    if change.change == ADD:
        values = change.section["parameters"].items()
        sizes = ", ".join(f"{n.replace('_', ' ')} {_quantity(v)}" for n, v in values)
        lines = [f"{name} {verb} part of the model: {sizes}."]
    else:
        lines = [f"{name} {verb} no longer part of the model."]
    return lines + _errors(change.errors)


def _quantity(value: Mapping[str, Any]) -> str:
    return quantity(Value(value["value"], value.get("sd", float("nan")), value["unit"]))


def _errors(errors: Mapping[str, Any]) -> list[str]:
    """Sentences on both parts; none where no trace was there to judge by."""
    if not errors:
        return []
    rho, learned = errors.get("rho", {}), errors.get("identification_pct", {})
    held_out, floor = errors.get("heldout_pct", {}), errors.get("noise_floor_pct")
    lines = []
    if len(rho) == len(learned) == 2:
        lines.append(
            f"Identification part: error {_fall(learned)}; residual variance {rho['before']:.3g} "
            f"times the noise's before, {rho['after']:.3g} after."
        )
    if len(held_out) == 2 and floor is not None:
        words = f"; the sensors' floor is {floor:.2f} %" if is_floor(floor) else ""
        lines.append(
            f"Held-out part: error {_fall(held_out)}{words} "
            f"(over the {errors.get('judged_s', 0.0):.1f} s where the map is known)."
        )
    shown = tuple(Bar(name, value) for name, value in held_out.items())
    return lines + bars(Bars("", "", shown, floor if is_floor(floor) else nan, "floor", ""))


def _fall(pair: Mapping[str, float]) -> str:
    return f"{pair['before']:.2f} % of the rms flow before, {pair['after']:.2f} % after"


def as_json(done: Revised) -> dict[str, Any]:
    """Everything that the text says, SI units."""
    return {
        "schema": SCHEMA,
        "project": str(done.project),
        "written": done.is_written,
        "changes": [plain(change) for change in done.changes],
        "note": done.note,
    }
