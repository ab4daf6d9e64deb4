"""What a fleet tells: how many traces, which failed and why, which machines are worth a look."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtid.fleet.trend import series, trend
from rtid.plain import plain
from rtid.tell.story import Table
from rtid.tell.terminal import make_console
from rtid.units import scale_of, with_unit

SCHEMA = 1
SHOWN = 20
FAR = 3.0  # deviation in units of the spread from which a machine's map is remarkable


def summary(
    rows: Sequence[Mapping[str, Any]],
    machines: Sequence[Mapping[str, Any]],
    copies: int,
    tried_again: int,
) -> dict[str, Any]:
    """Plain JSON types; numbers that are not finite are null."""
    failed = [row for row in rows if row["error"]]
    units = _units(rows)
    trends = [trend(f"{machine}: {name}", t, y) for machine, name, t, y in series(rows)]
    return {
        "schema": SCHEMA,
        "traces": len(rows),
        "copies_left_out": copies,
        "tried_again": tried_again,
        "cpu_s": sum(row["cpu_s"] for row in rows),
        "verdicts": dict(Counter(r["verdict"] or "not diagnosed" for r in rows if not r["error"])),
        "errors": [{k: row[k] for k in ("machine", "trace", "error", "remedy")} for row in failed],
        "machines": [{k: plain(v) for k, v in machine.items()} for machine in machines],
        "trends": [
            {"name": t.name, "unit": units.get(t.name, "Pa"), "per_day": t.slope,
             "interval": [t.slope_low, t.slope_high],
             "changed_after_days": plain(t.change_d), "changed_by": t.change_by, "now": t.level}
            for t in trends
            if t.is_drifting or np.isfinite(t.change_d)
        ],
    }  # fmt: skip


def _units(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """SI unit of every effect that is followed, by the names of the trends; moduli have none."""
    return {
        f"{row['machine']}: {effect}:{where}": unit
        for row in rows
        for effect, where, unit in zip(row["effects"], row["places"], row["units"], strict=True)
    }


def tell(document: Mapping[str, Any], folder: Path) -> None:
    """Print a summary: sentences, the machines, the errors, what changes."""
    console = make_console()
    counts = ", ".join(f"{n} {verdict}" for verdict, n in document["verdicts"].items())
    console.print(
        f"{document['traces']} traces of {len(document['machines'])} machines: "
        f"{counts or 'no verdict'}; "
        f"{len(document['errors'])} failed, {document['copies_left_out']} copies left out."
    )
    console.print(_machines(document["machines"][:SHOWN]))
    if len(document["machines"]) > SHOWN:
        console.print(f"... and {len(document['machines']) - SHOWN} more in machines.parquet")
    for error in document["errors"][:SHOWN]:
        console.print(f"failed: {error['machine']}: {error['error']}", soft_wrap=True)
    for row in document["trends"][:SHOWN]:
        console.print(_changing(row), soft_wrap=True)
    console.print(f"Results in {folder}: runs/, machines.parquet, maps/, typical-*.csv")


def _machines(rows: Sequence[Mapping[str, Any]]) -> Table:
    pressure, cells = scale_of("Pa"), []
    for row in rows:
        off = row["deviation"]
        text = "" if off is None else f"{off:.1f} spreads" + (" !" if off > FAR else "")
        beta = " / ".join(pressure.number(b, 0) for b in row["beta_pa"])
        words = ", ".join(e.replace("_", " ") for e in row["effects"])
        cells.append((row["machine"], str(row["traces"]), row["verdict"], words, text, beta))
    heads = ("machine", "traces|", "verdict", "effects~", "map off its type by|")
    title = "machines, the most remarkable first"
    return Table(title, (*heads, f"beta, {pressure.name}|"), cells)


def _changing(row: Mapping[str, Any]) -> str:
    def words(name: str) -> str:
        return with_unit(row[name], row["unit"])

    if row["changed_after_days"] is not None:
        return (
            f"changed: {row['name']} by {words('changed_by')} after "
            f"{row['changed_after_days']:.1f} days; now {words('now')}"
        )
    low, high = (with_unit(end, row["unit"]) for end in row["interval"])
    return (
        f"drifting: {row['name']} by {words('per_day')} a day (95 %: {low} to {high}); "
        f"now {words('now')}"
    )
