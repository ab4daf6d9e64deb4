"""`rtid status`: how the daemon is, from another shell."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.cli.exits import Exit
from rtid.cli.options import Where

if TYPE_CHECKING:
    from rich.console import Console

    from rtid.daemon.status import Status


def status(
    where: Where,
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
    metrics: Annotated[
        bool, typer.Option("--metrics", help="Print it as Prometheus metrics.")
    ] = False,
) -> None:
    """Tell how the daemon is: bus, signals, loop, maps, storage, alarms, verdict, coach.

    Exit code 4 if it does not run, or an alarm is on.
    """
    from rtid.daemon.configure import state_of
    from rtid.daemon.metrics import exposition
    from rtid.daemon.status import OLD_S, read
    from rtid.offered import as_text

    folder = state_of(where)
    found = read(folder)
    age_s = time.time() - found.now_unix_s
    on = [alarm for alarm in found.alarms if alarm.until_unix_s is None]
    if as_json:
        print(found.to_json())
    elif metrics:
        print(exposition(found, age_s), end="")
    else:
        _show(found, age_s)
        if text := as_text(folder):
            print(f"offered `rtid apply`: {text}")
    if on or age_s > OLD_S:
        raise typer.Exit(Exit.NEGATIVE)


def _show(found: Status, age_s: float) -> None:
    from rich.console import Console

    from rtid.daemon.status import OLD_S

    console = Console(highlight=False, soft_wrap=True)
    up_s = found.now_unix_s - found.started_unix_s
    alive = f"up {up_s:.0f} s" if age_s <= OLD_S else f"NOT RUNNING: last heard {age_s:.0f} s ago"
    console.print(f"{found.name}: {alive}, process {found.pid}, {found.rss_anon_mb:.0f} MB")
    bus, loop, store = found.bus, found.loop, found.store
    console.print(
        f"bus     {bus.interface} {bus.channel}: {bus.state}, {bus.frames} frames, "
        f"{bus.frames_per_s:.0f}/s, opened again {bus.reopened} times"
    )
    console.print(
        f"loop    {loop.rate_hz:g} Hz ({loop.scheduling}), work p50/p99/max "
        f"{loop.work.p50_us:.0f}/{loop.work.p99_us:.0f}/{loop.work.max_us:.0f} us, late "
        f"{loop.lateness.p50_us:.0f}/{loop.lateness.p99_us:.0f}/{loop.lateness.max_us:.0f} us, "
        f"{loop.overruns} overruns in {loop.ticks} ticks {loop.causes or ''}"
    )
    console.print(f"maps    {_maps(found)}")
    saved = "never" if store.age_s is None else f"{store.age_s:.0f} s ago"
    console.print(f"state   {store.state}, last {saved}, began {store.restored}. {store.reason}")
    _tables(console, found)
    if found.verdict is not None:
        console.print(f"verdict {found.verdict.verdict}: {found.verdict.text}")
    if found.advice is not None:
        console.print(f"coach   {found.advice.text}")
    for alarm in found.alarms:
        over = "" if alarm.until_unix_s is None else " (over)"
        console.print(f"ALARM   {alarm.name}{over}: {alarm.text} {alarm.trace}")


def _maps(found: Status) -> str:
    estimate = found.estimate
    blocks = {
        name: sum(edge.blocks.get(name, 0) for edge in estimate.edges)
        for edge in estimate.edges
        for name in edge.blocks
    }
    beta = ", ".join(
        f"{c.name} {c.beta_pa / 1e6:.1f} +- {(c.beta_sd_pa or 0.0) / 1e6:.1f} MPa"
        for c in estimate.chambers
        if c.beta_pa is not None
    )
    age = "-" if estimate.age_s is None else f"{1e3 * estimate.age_s:.0f} ms"
    stale = " STALE" if estimate.stale else ""
    told = ", ".join(f"{n} {name}" for name, n in sorted(blocks.items())) or "none yet"
    return (
        f"{estimate.state} {estimate.reason}, {estimate.samples} samples, newest {age} old{stale}; "
        f"blocks {told}; beta {beta or 'unknown'}"
    )


def _tables(console: Console, found: Status) -> None:
    from rich.table import Table

    table = Table("message", "Hz", "of", "age ms", "gap ms", "", "refused", box=None)
    for m in found.messages:
        age = "-" if m.age_s is None else f"{1e3 * m.age_s:.0f}"
        refused = " ".join(f"{name}={n}" for name, n in m.refused.items())
        table.add_row(
            m.name, f"{m.rate_hz:.0f}", f"{m.nominal_hz:.0f}", age, f"{1e3 * m.gap_s:.0f}",
            m.verdict, refused,
        )  # fmt: skip
    console.print(table)
    table = Table("signal", "value", "least", "largest", "unit", "", box=None)
    for s in found.signals:
        numbers = ("-" if v is None else f"{v:.6g}" for v in (s.value, s.minimum, s.maximum))
        table.add_row(s.name, *numbers, s.unit, s.verdict)
    console.print(table)
