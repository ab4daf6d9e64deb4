"""`rtid check`: judge a project file against a trace, or a raw capture by itself."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtid.cli.exits import Exit, refuse_truncated
from rtid.cli.options import AsJson

if TYPE_CHECKING:
    from rich.console import Console

    from firmware_bridge.catalog import Catalog
    from rtid.check import IdTiming, Report, Timing
    from rtid.project import Project

SCHEMA = 1
WIDTH = 110  # where the output is no terminal
TIMING_HEADS = ("count", "median", "1 %", "99 %", "worst", "gaps")


def check(
    project: Annotated[Path, typer.Argument(help="Project file; with --bus-only the capture.")],
    trace: Annotated[Path | None, typer.Argument(help="CAN log or table to judge it by.")] = None,
    bus_only: Annotated[
        bool, typer.Option("--bus-only", help="No project: judge a raw capture, id by id.")
    ] = False,
    dbc: Annotated[Path | None, typer.Option(help="Names of messages, for --bus-only.")] = None,
    as_json: AsJson = False,
) -> None:
    """Judge a project file, alone or against a trace.

    Rates, gaps, ranges, noise, units and signs, and which blocks of the flow maps the trace will
    excite.  Exit code 4 if the trace would be learnt wrongly.
    """
    if bus_only:
        _check_bus(project, dbc, as_json)
        return
    from rtid.project import load

    loaded = load(project)
    if trace is None:
        _print_project(loaded, as_json)
        return
    from rtid.check import judge
    from rtid.check.reading import read_trace

    read = read_trace(loaded, trace)
    stroke_m = loaded.sections.geometry.stroke_m
    assembly = loaded.table_assembly if read.is_table and loaded.table_assembly else loaded.assembly
    report = judge(
        loaded.model, assembly, read.samples, read.series, read.messages, read.refused, stroke_m
    )
    if as_json:
        print(json.dumps({"schema": SCHEMA, "ok": report.ok} | _plain(report)))
    else:
        _print_report(report, loaded)
    refuse_truncated(trace, read.refused)
    if not report.ok:
        raise typer.Exit(Exit.NEGATIVE)


def _check_bus(log: Path, dbc: Path | None, as_json: bool) -> None:
    from firmware_bridge import catalog
    from firmware_bridge.sources import open_log
    from rtid.check import bus

    frames = open_log(log)
    names = _names(catalog.load(dbc)) if dbc else {}
    found = bus(frames)
    if as_json:
        ids = [_plain(one) | {"name": names.get((one.can_id, one.extended))} for one in found]
        counts = {"frames": len(frames), "ids": len(found), "refused": frames.refused}
        print(json.dumps({"schema": SCHEMA} | counts | {"timing": ids}))
    else:
        _print_bus(found, names, len(frames), frames.refused)
    refuse_truncated(log, frames.refused)


def _names(catalog: Catalog) -> dict[tuple[int, bool], str]:
    messages = [catalog.message(name) for name in catalog.names]
    return {(m.frame_id, m.is_extended_frame): m.name for m in messages}


def _plain(value: Any) -> Any:
    """JSON form of dataclasses and arrays; a number that is none becomes null."""
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        return {name: _plain(getattr(value, name)) for name in names}
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, tuple | list):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _console() -> Console:
    from rich.console import Console

    console = Console(highlight=False, soft_wrap=False)
    return console if console.is_terminal else Console(width=WIDTH, highlight=False)


def _table(title: str, heads: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> Any:
    from rich.table import Table

    table = Table(*heads, title=title, title_justify="left", box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    for row in rows:
        table.add_row(*row)
    return table


def _timing_cells(found: Timing) -> tuple[str, ...]:
    steps = (found.median_s, found.p01_s, found.p99_s, found.worst_s)
    shown = [f"{1e3 * step:.4g} ms" if math.isfinite(step) else "-" for step in steps]
    return (str(found.count), *shown, str(found.gaps))


def _print_bus(
    found: tuple[IdTiming, ...],
    names: dict[tuple[int, bool], str],
    count: int,
    refused: dict[str, int],
) -> None:
    console = _console()
    rows = [
        (f"{one.channel}:{one.label}", names.get((one.can_id, one.extended), ""))
        + _timing_cells(one.timing)
        for one in found
    ]
    console.print(_table("Inter-arrival times", ("channel:id", "message", *TIMING_HEADS), rows))
    identifiers = len({(one.can_id, one.extended) for one in found})
    channels = len({one.channel for one in found})
    console.print(f"\n{count} frames, {identifiers} ids, {channels} channel(s).")
    if refused:
        console.print("Left out: " + _counts(refused))


def _print_project(project: Project, as_json: bool) -> None:
    """A valid project without a trace: what it declares."""
    model = project.model
    counts = {
        "signals": len(model.signals),
        "chambers": len(model.chambers),
        "edges": len(model.edges),
        "blocks": sum(math.prod(edge.grid.shape) for edge in model.edges),
    }
    if as_json:
        print(json.dumps({"schema": SCHEMA, "ok": True, "digest": project.digest} | counts))
        return
    declared = ", ".join(f"{n} {what}" for what, n in counts.items())
    _console().print(f"{project.path}: {project.name} is valid: {declared}.")
    _console().print("Name a trace to judge it by: rtid check PROJECT TRACE")


def _print_report(report: Report, project: Project) -> None:
    console = _console()
    rows = [(name, *_timing_cells(found)) for name, found in report.messages.items()]
    rows.append(("complete samples", *_timing_cells(report.samples)))
    console.print(_table("Timing", ("message", *TIMING_HEADS), rows), "")
    console.print(_signal_table(report, project), "")
    console.print(_coverage_table(report), "")
    if report.refused:
        console.print("Refused: " + _counts(report.refused))
    for finding in report.findings:
        console.print(f"{finding.level.upper()} {finding.subject}: {finding.text}.", markup=False)
        console.print(f"  -> {finding.remedy}", markup=False)
    console.print(_conclusion(report))


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{reason} {n}" for reason, n in counts.items())


def _signal_table(report: Report, project: Project) -> Any:
    heads = ("signal", "unit", "from", "to", "smallest step", "noise", "declared", "frozen")
    rows = []
    for one in report.signals:
        signal = project.model.signals[project.model.column(one.name)]
        numbers = (one.minimum, one.maximum, one.step, one.noise, signal.noise)
        shown = [f"{number:.4g}" for number in numbers]
        shown[-1] = "estimate" if one.name in project.noise_unknown else shown[-1]
        frozen = f"{one.frozen_s:.3g} s" if one.frozen_s else "-"
        rows.append((one.name, signal.unit, *shown, frozen))
    return _table("Signals", heads, rows)


def _coverage_table(report: Report) -> Any:
    heads = ("edge", "blocks", "excited", "touched", "open", "outside grid", "command", "dp MPa")
    rows = [
        (
            one.edge,
            str(one.rows.size),
            str(one.enough),
            str(one.touched),
            f"{one.open_s:.4g} s",
            f"{100 * one.outside:.1f} %",
            f"{one.w_v[0]:.3g}..{one.w_v[1]:.3g}",
            f"{1e-6 * one.dp_pa[0]:.3g}..{1e-6 * one.dp_pa[1]:.3g}",
        )
        for one in report.coverage
    ]
    return _table("Flow maps: blocks that this trace excites", heads, rows)


def _conclusion(report: Report) -> str:
    errors = sum(finding.level == "error" for finding in report.findings)
    warnings = len(report.findings) - errors
    blocks = sum(one.enough for one in report.coverage)
    if errors:
        return f"\nNot ready: {errors} error(s), {warnings} warning(s). Mend the errors first."
    ready = f"\nReady to learn: {report.duration_s:.4g} s excite {blocks} blocks"
    return f"{ready}; {warnings} warning(s)." if warnings else f"{ready}; nothing to object to."
