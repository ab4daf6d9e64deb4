"""What a fleet tells: how many traces, which failed and why, which machines are worth a look."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from rtid.compared_text import make_console
from rtid.fleet.trend import series, trend
from rtid.units import MPA

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
    trends = [trend(f"{machine}: {name}", t, y) for machine, name, t, y in series(rows)]
    return {
        "schema": SCHEMA,
        "traces": len(rows),
        "copies_left_out": copies,
        "tried_again": tried_again,
        "cpu_s": sum(row["cpu_s"] for row in rows),
        "verdicts": dict(Counter(r["verdict"] or "not diagnosed" for r in rows if not r["error"])),
        "errors": [{k: row[k] for k in ("machine", "trace", "error", "remedy")} for row in failed],
        "machines": [{k: _plain(v) for k, v in machine.items()} for machine in machines],
        "trends": [
            {"name": t.name, "per_day": t.slope, "interval": [t.slope_low, t.slope_high],
             "changed_after_days": _plain(t.change_d), "changed_by": t.change_by, "now": t.level}
            for t in trends
            if t.is_drifting or np.isfinite(t.change_d)
        ],
    }  # fmt: skip


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def tell(told: Mapping[str, Any], folder: Path) -> None:
    """Print a summary: sentences, the machines, the errors, what changes."""
    console = make_console()
    counts = ", ".join(f"{n} {verdict}" for verdict, n in told["verdicts"].items())
    console.print(
        f"{told['traces']} traces of {len(told['machines'])} machines: {counts or 'no verdict'}; "
        f"{len(told['errors'])} failed, {told['copies_left_out']} copies left out."
    )
    console.print(_machines(told["machines"][:SHOWN]))
    if len(told["machines"]) > SHOWN:
        console.print(f"... and {len(told['machines']) - SHOWN} more in machines.parquet")
    for error in told["errors"][:SHOWN]:
        console.print(f"failed: {error['machine']}: {error['error']}", soft_wrap=True, markup=False)
    for one in told["trends"][:SHOWN]:
        console.print(_changing(one), soft_wrap=True, markup=False)
    console.print(
        f"Results in {folder}: runs/, machines.parquet, maps/, typical-*.csv", markup=False
    )


def _machines(rows: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(title="machines, the most remarkable first", title_justify="left")
    for head in ("machine", "traces", "verdict", "effects", "map off its type by", "beta, MPa"):
        table.add_column(head)
    for row in rows:
        off = row["deviation"]
        text = "" if off is None else f"{off:.1f} spreads" + (" !" if off > FAR else "")
        beta = " / ".join(f"{MPA * b:.0f}" for b in row["beta_pa"])
        words = ", ".join(e.replace("_", " ") for e in row["effects"])
        table.add_row(row["machine"], str(row["traces"]), row["verdict"], words, text, beta)
    return table


def _changing(one: Mapping[str, Any]) -> str:
    if one["changed_after_days"] is not None:
        return (
            f"changed: {one['name']} by {one['changed_by']:.3g} after "
            f"{one['changed_after_days']:.1f} days; now {one['now']:.3g}"
        )
    low, high = one["interval"]
    return (
        f"drifting: {one['name']} by {one['per_day']:.3g} a day ({low:.3g} to {high:.3g}); "
        f"now {one['now']:.3g}"
    )
