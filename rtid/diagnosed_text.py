"""A diagnosis as an engineer reads it: sentences first, then the tables."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from rtid.diagnose.report import Diagnosis, Effect, Unseen, Value
from rtid.diagnose.trials import MATCH_RHO
from rtid.diagnose.verdict import MATERIAL
from rtid.effects import catalogue
from rtid.units import PRACTICAL

WIDTH = 110  # where the output is no terminal
DISPLAY = {si: PRACTICAL[si] for si in ("s", "m3", "Pa", "m3/s")}  # coefficients stay in SI
SHOWN = 14  # rows of the table of what was not found


def show(found: Diagnosis) -> None:
    """Print a diagnosis."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=WIDTH)
    for sentence in sentences(found):
        console.print(sentence)
    for table in (_found_table(found), _unseen_table(found)):
        if table.row_count:
            console.print()
            console.print(table)


def sentences(found: Diagnosis) -> list[str]:
    """The verdict in plain words."""
    lines = [*_added(found), _head(found)]
    if not found.held_out_judged:
        lines.append(
            "The map is known over too little of the held-out part: the errors are those of the "
            "record that taught the model."
        )
    lines += [_one(found, effect) for effect in found.found]
    if found.something_remains and found.verdict == "matches":
        lines.append(
            "What remains beyond the noise is immaterial: less than "
            f"{100 * MATERIAL:g} % of the rms flow."
        )
    elif found.something_remains:
        lines.append(
            f"Something else remains: the residual variance is still {found.rho_after:.2f} times "
            "the noise."
        )
    if found.negligible:
        names = ", ".join(f"{title(s.effect)} ({s.where})" for s in found.negligible)
        lines.append(
            f"Seen, but too small on this motion to be sized: {names}."
            if found.verdict == "insufficient_data"
            else f"Too small to matter, if there at all: {names}."
        )
    return lines + [f"{text}" for text in found.advice[:4]]


def _added(found: Diagnosis) -> list[str]:
    names = ", ".join(f"{title(a.effect)} at {a.where}" for a in found.added)
    return [f"The model has {names}, added before."] if names else []


def _head(found: Diagnosis) -> str:
    share = percent(found, found.heldout_residual_before_m3s)
    floor = percent(found, found.noise_floor_m3s)
    match found.verdict:
        case "matches":
            return (
                f"The model matches: held-out error {share} of the rms flow, the sensors' floor is "
                f"{floor}; residual variance {found.rho_before:.2f} of the noise."
            )
        case "unknown":
            return (
                f"Something is missing that no known effect explains: held-out error {share}, the "
                f"sensors' floor is {floor}; residual variance {found.rho_before:.3g} of the noise."
            )
        case "insufficient_data":
            return f"The record holds too little motion to tell{_left(found)}."
    return (
        f"The model does not match: residual variance {found.rho_before:.3g} times the noise, "
        f"{found.rho_after:.2f} with what was found."
    )


def _left(found: Diagnosis) -> str:
    """What speaks against the model where nothing can be named."""
    if not found.rho_before > MATCH_RHO:
        return ""
    return (
        f", but the model misses something: residual variance {found.rho_before:.3g} of the "
        "noise, most of which the maps may have taken in"
    )


def _one(found: Diagnosis, effect: Effect) -> str:
    sizes = ", ".join(
        f"{name.replace('_', ' ')} {quantity(v)}" for name, v in effect.parameters.items()
    )
    before = percent(found, effect.heldout_residual_before_m3s)
    after = percent(found, effect.heldout_residual_after_m3s)
    text = (
        f"{title(effect.effect)} at {effect.where}: {sizes}. Adding it lowers the held-out error "
        f"from {before} to {after}; the sensors' floor is {percent(found, found.noise_floor_m3s)}."
    )
    if effect.cannot_be_told_from:
        others = ", ".join(name.replace("_", " ") for name in effect.cannot_be_told_from)
        text += f" It cannot be told apart from {others} in this record."
    return text


def title(name: str) -> str:
    """The effect's title, from its page where there is one."""
    page = catalogue().get(name)
    return page.title if page else name.replace("_", " ")


def quantity(value: Value) -> str:
    """Value, interval and unit, in display units."""
    unit, factor = DISPLAY.get(value.unit, (value.unit, 1.0))
    unit = "" if unit == "1" else f" {unit}"
    if value.std != value.std:
        return f"{factor * value.value:.4g}{unit}"
    return f"{factor * value.value:.4g} +- {factor * value.std:.2g}{unit}"


def percent(found: Diagnosis, residual_m3s: float) -> str:
    """A residual as a share of the rms flow."""
    return f"{100 * residual_m3s / found.rms_flow_m3s:.2f} %"


def _found_table(found: Diagnosis) -> Table:
    table = Table(title="found", title_justify="left")
    for name in ("effect", "where", "parameter", "value", "held-out gain", "p"):
        table.add_column(name)
    for effect in found.found:
        for k, (name, value) in enumerate(effect.parameters.items()):
            first = (effect.effect, effect.where) if k == 0 else ("", "")
            last = (
                (f"{effect.heldout_gain_pct:.1f} %", f"{effect.p_value:.1g}")
                if k == 0
                else ("", "")
            )
            table.add_row(*first, name, quantity(value), *last)
    return table


def _unseen_table(found: Diagnosis) -> Table:
    table = Table(title="not found, and the smallest size that this record would have shown",
                  title_justify="left")  # fmt: skip
    for name in ("effect", "where", "detection limit", "remark"):
        table.add_column(name)
    rows: list[Unseen] = sorted(found.not_found, key=lambda u: not u.visible)
    for unseen in [u for u in rows if u.detection_limit is not None][: 3 * SHOWN]:
        limit = quantity(Value(unseen.detection_limit or 0.0, float("nan"), unseen.unit))
        table.add_row(unseen.effect, unseen.where, limit if unseen.visible else "cannot be seen",
                      unseen.reason)  # fmt: skip
    return table
