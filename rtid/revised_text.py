"""Changes of a model as a user reads them: sentences, bars of the error, the table of history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table

from rtid.diagnose.report import Value
from rtid.diagnosed_text import quantity, title
from rtid.project.history import ADD, UNDO, Change, standing
from rtid.revising import Revised

SCHEMA = 1
WIDTH = 110  # where the output is no terminal
BAR = 40  # longest bar, characters
EIGHTHS = " ▏▎▍▌▋▊▉"


def show(done: Revised) -> None:
    """Print what a command did, or would do."""
    console = _console()
    for change in done.changes:
        for line in sentences(change, done.is_written):
            console.print(line, markup=False)
    if done.note:
        console.print(done.note, markup=False)
    if done.is_written:
        back = "" if done.changes[-1].change == UNDO else "; `rtid undo` takes it back"
        console.print(f"wrote {done.project}{back}", markup=False)
    else:
        console.print(f"{done.project} is as it was: a trial", markup=False)


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
    held, floor = errors.get("heldout_pct", {}), errors.get("noise_floor_pct")
    lines = []
    if len(rho) == len(learned) == 2:
        lines.append(
            f"Identification part: error {_fall(learned)}; residual variance {rho['before']:.3g} "
            f"times the noise before, {rho['after']:.3g} after."
        )
    if len(held) == 2 and floor is not None:
        lines.append(
            f"Held-out part: error {_fall(held)}; the sensors' floor is {floor:.2f} % "
            f"(over the {errors.get('judged_s', 0.0):.1f} s where the map is known)."
        )
    return lines + bars(held, floor)


def _fall(pair: Mapping[str, float]) -> str:
    return f"{pair['before']:.2f} % of the rms flow before, {pair['after']:.2f} % after"


def bars(pair: Mapping[str, float], floor: float | None) -> list[str]:
    """Held-out error before and after, and the floor, as bars of one scale."""
    shown = {**pair} | ({} if floor is None else {"floor": floor})
    largest = max(shown.values(), default=0.0)
    if not largest > 0:
        return []
    return [f"  {name:7}{_bar(value / largest)} {value:.2f} %" for name, value in shown.items()]


def _bar(share: float) -> str:
    whole, rest = divmod(round(8 * BAR * share), 8)
    return "█" * whole + EIGHTHS[rest].strip()


def show_history(changes: Sequence[Change]) -> None:
    """Print the table of all changes."""
    table = Table(title="history: errors in % of the rms flow", title_justify="left")
    for name in ("", "date", "change", "identification", "held-out", "floor", "reason"):
        table.add_column(name, overflow="fold", no_wrap=name in ("date", "identification"))
    alive = {change.number for change in standing(changes)}
    for c in changes:
        taken_back = c.change != UNDO and c.number not in alive
        table.add_row(
            str(c.number),
            c.date[:10],
            f"{c.change} {c.effect}:{c.where}" + (" (taken back)" if taken_back else ""),
            _arrow(c.errors.get("identification_pct", {})),
            _arrow(c.errors.get("heldout_pct", {})),
            f"{c.errors['noise_floor_pct']:.2f}" if "noise_floor_pct" in c.errors else "",
            c.reason,
        )
    _console().print(table if changes else "no change yet: `rtid add` makes the first")


def _arrow(pair: Mapping[str, float]) -> str:
    return f"{pair['before']:.2f} -> {pair['after']:.2f}" if len(pair) == 2 else ""


def as_json(done: Revised) -> dict[str, Any]:
    """Everything that the text says, SI units."""
    return {
        "schema": SCHEMA,
        "project": str(done.project),
        "written": done.is_written,
        "changes": [plain(change) for change in done.changes],
        "note": done.note,
    }


def plain(change: Change) -> dict[str, Any]:
    """A change without the text of the file."""
    return {k: v for k, v in asdict(change).items() if k not in ("before", "after_sha256")}


def _console() -> Console:
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=WIDTH)
