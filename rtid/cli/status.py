"""`rtid status`: how the daemon is, from another shell."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtid.cli.exits import Exit
from rtid.cli.options import UnitsOption, Where
from rtid.units import CONVENTION, System, scale_of

if TYPE_CHECKING:
    from rtid.daemon.status import Status
    from rtid.tell.story import Table


def status(
    where: Where,
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
    metrics: Annotated[
        bool, typer.Option("--metrics", help="Print it as Prometheus metrics.")
    ] = False,
    serve: Annotated[
        str | None,
        typer.Option(help="Serve the metrics over HTTP until Ctrl-C: PORT or HOST:PORT."),
    ] = None,
    board: Annotated[
        bool, typer.Option("--board", help="Print a Grafana board for these metrics.")
    ] = False,
    units: UnitsOption = System.DISPLAY,
) -> None:
    """Tell how the daemon is: bus, signals, loop, maps, storage, alarms, verdict, coach.

    Exit code 4 if it does not run, or an alarm is on.  --serve answers a scraper beside the daemon,
    which itself opens no port.
    """
    from rtid.apply.offer import as_text
    from rtid.daemon import metrics as metrics_module
    from rtid.daemon.metrics import exposition
    from rtid.daemon.status import OLD_S, read
    from rtid.project.folder import state_of

    if board:
        print(Path(metrics_module.__file__).with_name("board.json").read_text("utf-8"), end="")
        return
    folder = state_of(where)
    if serve is not None:
        _serve(folder, serve)
        return
    daemon_status = read(folder)
    age_s = time.time() - daemon_status.now_unix_s
    if as_json:
        print(daemon_status.to_json())
    elif metrics:
        print(exposition(daemon_status, age_s), end="")
    else:
        _show(daemon_status, age_s)
        if text := as_text(folder):
            print(f"offered `rtid apply`: {text}")
    if daemon_status.on or age_s > OLD_S:
        raise typer.Exit(Exit.NEGATIVE)


def _serve(folder: Path, place: str) -> None:
    """Answer scrapers until interrupted."""
    from rtid.daemon.scrape import server

    with server(folder, place) as answers:
        print(
            f"http://{answers.server_name}:{answers.server_port}/metrics  (Ctrl-C ends it)",
            flush=True,
        )
        answers.serve_forever()


def _show(daemon_status: Status, age_s: float) -> None:
    from rtid.daemon.status import OLD_S
    from rtid.tell.terminal import make_console

    console = make_console()
    console.soft_wrap = True
    up_s = daemon_status.now_unix_s - daemon_status.started_unix_s
    alive = f"up {up_s:.0f} s" if age_s <= OLD_S else f"NOT RUNNING: last heard {age_s:.0f} s ago"
    console.print(
        f"{daemon_status.name}: {alive}, process {daemon_status.pid}, "
        f"{daemon_status.rss_anon_mb:.0f} MB"
    )
    bus, loop, store = daemon_status.bus, daemon_status.loop, daemon_status.store
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
    maps = _maps(daemon_status)
    console.print(f"maps    {maps}")
    effects = _effects(daemon_status)
    if effects:
        console.print(f"effects {effects}")
    if "±" in maps + effects:
        console.print(f"        {CONVENTION}")
    saved = "never" if store.age_s is None else f"{store.age_s:.0f} s ago"
    console.print(f"state   {store.state}, last {saved}, began {store.restored}. {store.reason}")
    console.print(_messages(daemon_status), soft_wrap=False)
    console.print(_signals(daemon_status), soft_wrap=False)
    if daemon_status.verdict is not None:
        console.print(f"verdict {daemon_status.verdict.verdict}: {daemon_status.verdict.text}")
    if daemon_status.advice is not None:
        console.print(f"coach   {daemon_status.advice.text}")
    for alarm in daemon_status.alarms:
        over = "" if alarm.is_on else " (over)"
        console.print(f"ALARM   {alarm.name}{over}: {alarm.words} {alarm.trace}")


def _maps(daemon_status: Status) -> str:
    estimate = daemon_status.estimate
    pressure = scale_of("Pa")
    beta = ", ".join(
        f"{c.name} {pressure.known(c.beta_pa, c.beta_sd_pa or 0.0, 1)} {pressure.name}"
        for c in estimate.chambers
        if c.beta_pa is not None
    )
    age = "-" if estimate.age_s is None else f"{1e3 * estimate.age_s:.0f} ms"
    stale = " STALE" if estimate.stale else ""
    text = ", ".join(f"{n} {name}" for name, n in estimate.blocks.items()) or "none yet"
    return (
        f"{estimate.state} {estimate.reason}, {estimate.samples} samples, newest {age} old{stale}; "
        f"blocks {text}; beta {beta or 'unknown'}"
    )


def _effects(daemon_status: Status) -> str:
    """What is learned on board of the sizes of added effects."""
    sizes = ((e, scale_of(e.unit)) for e in daemon_status.estimate.effects)
    return ", ".join(f"{e.name} {s.known(e.size, e.sd, 4)} {s.name}" for e, s in sizes)


def _messages(daemon_status: Status) -> Table:
    from rtid.tell.story import Table

    time = scale_of("s")
    rows = [
        (
            m.name,
            f"{m.rate_hz:.0f}",
            f"{m.nominal_hz:.0f}",
            "-" if m.age_s is None else time.number(m.age_s, 0),
            time.number(m.gap_s, 0),
            m.verdict,
            " ".join(f"{name}={n}" for name, n in m.refused.items()),
        )
        for m in daemon_status.messages
    ]
    heads = ("message", "Hz|", "of|", f"age {time.name}|", f"gap {time.name}|", "", "refused~")
    return Table("", heads, rows)


def _signals(daemon_status: Status) -> Table:
    from rtid.tell.story import Table

    rows = []
    for s in daemon_status.signals:
        scale = scale_of(s.unit)
        three = (s.value, s.minimum, s.maximum)
        value, least, most = ("-" if v is None else f"{scale.factor * v:.6g}" for v in three)
        rows.append((s.name, value, least, most, scale.name, s.verdict))
    return Table("", ("signal", "value|", "least|", "largest|", "unit", ""), rows)
