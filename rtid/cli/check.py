"""`rtid check`: judge a project file against a trace, or a raw capture by itself."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtid.cli.exits import Exit, refuse_truncated
from rtid.cli.options import AnyProject, AsJson, NoCache, UnitsOption, told_apart
from rtid.errors import RtidError
from rtid.plain import Progress, plain
from rtid.units import System, scale_of, with_unit

if TYPE_CHECKING:
    from firmware_bridge.catalog import Catalog
    from firmware_bridge.frames import Frames
    from firmware_bridge.mended import Mended
    from rtid.project import Project
    from rtid.tell.story import Table
    from rtid.trace.arrivals import IdTiming, Stamps, Timing
    from rtid.trace.check import Report
    from rtid.trace.described import Described

SCHEMA = 1
MOST_SHOWN = 8  # identifiers in a line
TIMING_HEADS = ("count|", "median|", "1 %|", "99 %|", "worst|", "gaps|")


def check(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="[TRACE] [PROJECT]",
            help="CAN log or table, and project file; with --bus-only the capture.",
        ),
    ],
    project: AnyProject = None,
    bus_only: Annotated[
        bool, typer.Option("--bus-only", help="No project: judge a raw capture, id by id.")
    ] = False,
    dbc: Annotated[Path | None, typer.Option(help="Names of messages, for --bus-only.")] = None,
    as_json: AsJson = False,
    units: UnitsOption = System.DISPLAY,
    no_cache: NoCache = False,
) -> None:
    """Judge a project file, alone or against a trace.

    Rates, gaps, ranges, noise, units and signs, and which blocks of the flow maps the trace will
    excite.  Exit code 4 if the trace would be learnt wrongly.
    """
    if bus_only:
        _check_bus(files[0], dbc, as_json)
        return
    from rtid.project import load

    traces, project = told_apart(files, project, "check")
    trace = next(iter(traces), None)
    if project is None:
        remedy = (
            f"rtid check {trace} -p PROJECT; `rtid quick {trace} --save machine.toml` writes one"
        )
        raise RtidError(f"{trace}: judged by which project?", remedy, Exit.USAGE)
    loaded = load(project)
    if trace is None:
        _print_project(loaded, as_json)
        return
    from rtid.tell.replay import progress_bar

    with progress_bar() as progress:
        report = _judged(loaded, trace, progress)
    if as_json:
        print(json.dumps({"schema": SCHEMA, "ok": report.ok} | plain(report)))
    else:
        _print_report(report, loaded)
    refuse_truncated(trace, report.refused)
    if not report.ok:
        raise typer.Exit(Exit.NEGATIVE)


def _judged(project: Project, path: Path, progress: Progress) -> Report:
    """The report of a trace, and what replay learns from it where nothing stands against that."""
    from rtid.estimator.flowmap import VALID
    from rtid.study.study import Study
    from rtid.trace.check import judge_recording, with_learned
    from rtid.trace.reading import NoSamplesError
    from rtid.trace.signals import read_recording

    progress("reading", 0.0)
    read = read_recording(project, path)
    progress("judging signals and motion", 0.2)
    report = judge_recording(project, read)
    if not report.ok:
        return report
    try:
        edges = Study(project, path, lambda t, share: progress(t, 0.4 + 0.6 * share)).map.edges
    except NoSamplesError:
        return with_learned(report, {edge.name: 0 for edge in project.model.maps})
    learned = {edge.name: int((edge.status == VALID).sum()) for edge in edges}
    pairs = zip(edges, project.model.maps, strict=True)
    finer = [edge.name for edge, given in pairs if edge.status.shape != given.grid.shape]
    return with_learned(report, learned, frozenset(finer))


def _check_bus(log: Path, dbc: Path | None, as_json: bool) -> None:
    from firmware_bridge import catalog
    from firmware_bridge.mended import mend
    from firmware_bridge.sources import open_log
    from rtid.trace.arrivals import bus, stamps
    from rtid.trace.described import described, match, on_channels

    raw = open_log(log, mended=False)
    mended = mend(raw)
    frames = mended.frames
    known = catalog.load(dbc) if dbc else None
    timings = bus(frames)
    names = [_name(known, timed) for timed in timings]
    matched = match(frames, known) if known else None
    signals = _signals(matched.by_name, known) if known and matched else []
    taken = described(matched, known) if known and matched else None
    channels = on_channels(frames)
    if as_json:
        ids = [plain(t) | {"name": name or None} for t, name in zip(timings, names, strict=True)]
        counts = {"frames": len(frames), "ids": len(timings), "refused": frames.refused}
        odd = {"stamps": plain(stamps(raw)) | _mending(mended), "on_channels": channels}
        odd |= {"described": plain(taken) if taken else None}
        print(json.dumps({"schema": SCHEMA} | counts | {"timing": ids, "signals": signals} | odd))
    else:
        _print_bus(timings, names, len(frames), frames.refused)
        _print_stamps(stamps(raw), mended)
        _print_channels(channels)
        _print_signals(signals)
        _print_described(taken)
    refuse_truncated(log, frames.refused)


def _name(catalog: Catalog | None, timed: IdTiming) -> str:
    """What the DBC calls a message; one of J1939 goes by its group, whoever sends it."""
    from firmware_bridge.frames import EXTENDED
    from firmware_bridge.j1939 import pgn_of

    can_id = timed.can_id | (EXTENDED if timed.extended else 0)
    for name in catalog.names if catalog else ():
        assert catalog is not None
        known = catalog.can_id(name)
        is_group = catalog.is_j1939(name) and timed.extended
        if known == can_id or (is_group and pgn_of(known) == pgn_of(can_id)):
            return catalog.message(name).name
    return ""


def _signals(by_name: dict[str, Frames], catalog: Catalog) -> list[dict[str, Any]]:
    """Every signal that the log holds by the DBC: its unit, values and range."""
    from rtid.trace.series import describe
    from rtid.trace.signals import series_of

    wanted = ("name", "count", "missing", "minimum", "maximum")
    return [
        {key: plain(getattr(report, key)) for key in wanted} | {"unit": unit}
        for unit, report in ((u, describe(series)) for u, series in series_of(by_name, catalog))
    ]


def _mending(mended: Mended) -> dict[str, float | None]:
    """How late the mended stamps were, and within how much they are known now; seconds."""
    mean_s, most_s = mended.late_s
    known_s = max(mended.known_s.values(), default=None)
    return {"mended_mean_s": mean_s, "mended_most_s": most_s, "known_s": known_s}


def _print_stamps(odd: Stamps, mended: Mended) -> None:
    """What is odd about the time stamps, and what it means for the lag; nothing if all is well."""
    from firmware_bridge.mended import MENDED, REORDERED

    if odd.backward:
        is_sorted = REORDERED in mended.frames.refused
        done = (
            "the frames are sorted by" if is_sorted else "such frames are refused as out_of_order"
        )
        print(f"{odd.backward} time stamps go back: {done}{' their stamps' * is_sorted}.")
    if odd.repeated:
        print(f"{odd.repeated} frames are the one before once more, with its stamp: refused.")
    if odd.in_bursts:
        print(
            f"{odd.in_bursts} frames came in bursts with one stamp, behind up to "
            f"{with_unit(odd.late_s, 's')} of silence: the adapter's stamps are late by up to "
            "that, and so would be the lag that is learned from them."
        )
    if mended.known_s:
        mean, most = (with_unit(late_s, "s") for late_s in mended.late_s)
        best, worst = (with_unit(f(mended.known_s.values()), "s") for f in (min, max))
        print(
            f"{mended.frames.refused[MENDED]} of them are put back to the steady periods of their "
            f"messages, by {mean}, at most {most}; they are known to {best} .. {worst} by message. "
            'A lag is uncertain by that: offset_ms = "estimate" under [messages.NAME] tells more.'
        )


def _print_channels(channels: dict[str, tuple[int, ...]]) -> None:
    for can_id, several in channels.items():
        on = ", ".join(map(str, several))
        print(f"{can_id} comes on channels {on}: a project names one, channel = {several[0]}.")


def _print_described(by: Described | None) -> None:
    """What each database takes and all of them leave, in a line each."""
    if by is None:
        return
    for taken in by.taken:
        print(
            f"{taken.file}: {taken.present} of its {taken.messages} messages are here, "
            f"{taken.frames} frames."
        )
    if by.left:
        few = ", ".join(list(by.left)[:MOST_SHOWN]) + (", ..." * (len(by.left) > MOST_SHOWN))
        print(f"Not described: {sum(by.left.values())} frames of {len(by.left)} ids: {few}.")
    for can_id, names in by.twice.items():
        print(f"{can_id} is {' and '.join(names)}: a project names which, and on which channel.")


def _print_signals(signals: list[dict[str, Any]]) -> None:
    from rtid.tell.story import Table
    from rtid.tell.terminal import make_console

    if signals:
        heads = ("signal", "unit", "values|", "not available|", "from|", "to|")
        keys = ("count", "missing", "minimum", "maximum")
        rows = [(s["name"], s["unit"], *(_shown(s[key]) for key in keys)) for s in signals]
        make_console().print("", Table("Signals", heads, rows))


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"


def _timing_cells(timing: Timing) -> tuple[str, ...]:
    steps = (timing.median_s, timing.p01_s, timing.p99_s, timing.worst_s)
    shown = [with_unit(step, "s") if math.isfinite(step) else "-" for step in steps]
    return (str(timing.count), *shown, str(timing.gaps))


def _print_bus(
    timings: tuple[IdTiming, ...], names: list[str], count: int, refused: dict[str, int]
) -> None:
    from rtid.tell.story import Table
    from rtid.tell.terminal import make_console

    console = make_console()
    if count:
        rows = [
            (f"{timing.channel}:{timing.label}", name, *_timing_cells(timing.timing))
            for timing, name in zip(timings, names, strict=True)
        ]
        heads = ("channel:id", "message", *TIMING_HEADS)
        console.print(Table("Inter-arrival times", heads, rows))
        identifiers = len({(timing.can_id, timing.extended) for timing in timings})
        channels = len({timing.channel for timing in timings})
        console.print(f"\n{count} frames, {identifiers} ids, {channels} channel(s).")
    else:
        console.print("No data frames.")
    if refused:
        console.print("Left out: " + _counts(refused))


def _print_project(project: Project, as_json: bool) -> None:
    """A valid project without a trace: what it declares."""
    model = project.model
    counts = {
        "signals": len(model.signals),
        "chambers": len(model.chambers),
        "edges": len(model.maps),
        "blocks": sum(math.prod(edge.grid.shape) for edge in model.maps),
    }
    if as_json:
        print(json.dumps({"schema": SCHEMA, "ok": True, "digest": project.digest} | counts))
        return
    declared = ", ".join(f"{n} {what}" for what, n in counts.items())
    print(f"{project.path}: {project.name} is valid: {declared}.")
    print("Name a trace to judge it by: rtid check TRACE -p PROJECT")


def _print_report(report: Report, project: Project) -> None:
    from rtid.tell.story import Table
    from rtid.tell.terminal import make_console

    console = make_console()
    rows = [(name, *_timing_cells(timing)) for name, timing in report.messages.items()]
    rows.append(("complete samples", *_timing_cells(report.samples)))
    console.print(Table("Timing", ("message", *TIMING_HEADS), rows), "")
    console.print(_signal_table(report, project), "")
    console.print(_coverage_table(report), "")
    if report.refused:
        console.print("Refused: " + _counts(report.refused))
    for finding in report.findings:
        console.print(f"{finding.level.upper()} {finding.subject}: {finding.text}.")
        console.print(f"  -> {finding.remedy}")
    console.print(_conclusion(report))


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{reason} {n}" for reason, n in counts.items())


def _signal_table(report: Report, project: Project) -> Table:
    from rtid.tell.story import Table

    rows = []
    for signal_report in report.signals:
        signal = project.model.signals[project.model.column(signal_report.name)]
        scale = scale_of(signal.unit)
        numbers = (
            signal_report.minimum,
            signal_report.maximum,
            signal_report.step,
            signal_report.noise,
            signal.noise,
        )
        shown = [f"{scale.factor * number:.4g}" for number in numbers]
        shown[-1] = "estimate" if signal_report.name in project.noise_unknown else shown[-1]
        frozen = f"{signal_report.frozen_s:.3g} s" if signal_report.frozen_s else "-"
        rows.append((signal_report.name, scale.name, *shown, frozen))
    heads = ("signal", "unit", "from|", "to|", "smallest step|", "noise|", "declared|", "frozen|")
    return Table("Signals", heads, rows)


def _coverage_table(report: Report) -> Table:
    from rtid.tell.story import Table

    pressure = scale_of("Pa")
    enough = max((coverage.min_rows for coverage in report.coverage), default=0)
    heads = ("edge", "blocks|", "learned|", f"{enough} rows|", "touched|", "open|", "outside|")
    rows = [
        (
            coverage.edge,
            str(coverage.rows.size),
            "-" if report.learned is None else str(report.learned[coverage.edge]),
            str(coverage.enough),
            str(coverage.touched),
            f"{coverage.open_s:.4g} s",
            f"{100 * coverage.outside:.1f} %",
            f"{coverage.w_v[0]:.3g}..{coverage.w_v[1]:.3g}",
            "..".join(f"{pressure.factor * dp:.3g}" for dp in coverage.dp_pa),
        )
        for coverage in report.coverage
    ]
    title = "Flow maps: blocks that replay learns from this trace"
    return Table(title, (*heads, "command|", f"dp {pressure.name}|"), rows)


def _conclusion(report: Report) -> str:
    errors = sum(finding.level == "error" for finding in report.findings)
    warnings = len(report.findings) - errors
    blocks = sum((report.learned or {}).values())
    if errors:
        return f"\nNot ready: {errors} error(s), {warnings} warning(s). Mend the errors first."
    ready = f"\nReady to learn: from {report.duration_s:.4g} s replay learns {blocks} blocks"
    return f"{ready}; {warnings} warning(s)." if warnings else f"{ready}; nothing to object to."
