"""From valid sections to the machine (`rtid.model.Machine`) and the bridge's `Assembly`."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace

import numpy as np

from firmware_bridge.catalog import Catalog
from firmware_bridge.config import CYCLE, MULTIRATE, Assembly, MessageSource, SignalSource
from rtid.effects.summed import RunningSum, sum_signal
from rtid.model import (
    AHEAD,
    BOTH,
    COMMAND_ONLY,
    MOST_MODE,
    NONE,
    OTHER,
    TAYLOR,
    Chamber,
    Edge,
    Filter,
    Gates,
    Grid,
    Lag,
    Machine,
    Signal,
    Upkeep,
)
from rtid.project.project import Sections
from rtid.project.references import KINDS, OTHERS
from rtid.project.schema import EdgeSection, MapSection, SignalSection
from rtid.units import Unit, find_unit, units_of

MIN_GAP_S = 0.05
_SI_UNIT = {"pressure": "Pa", "position": "m", "velocity": "m/s"}
_SI_OTHER = {"force": "N", "acceleration": "m/s2", "temperature": "K", "rotation": "rad/s"}
_SI_OTHER |= {"flow": "m3/s", "mass": "kg", "angle": "rad"}
NO_BORDERS = (-1.0, 1.0)  # of a second argument that a map has not


def build_model(sections: Sections, catalog: Catalog | None) -> Machine:
    """The declared machine, SI."""
    right = _right(sections, catalog).items()
    signals = _with_means_ahead(
        tuple(_signal(name, signal, catalog) for name, signal in right), _means_ahead(sections)
    )
    rate = sections.rate
    measured = rate.measured if rate and rate.measured else NONE
    if measured:
        of = next(s for s in signals if s.name == measured)
        signals = (*signals, sum_signal(of, max(e.rated_q_m3s for e in _edges(sections, ()))))
    gates, lag = sections.gates, sections.dynamics.spool_lag
    return Machine(
        signals=signals,
        chambers=_chambers(sections, signals),
        edges=_edges(sections, signals),
        position=_position(sections, signals),
        beta_nominal_pa=sections.beta.nominal_pa,
        beta_bounds_pa=sections.beta.bounds_pa,
        lag=Lag(lag.nominal_s, lag.tolerance_s),
        filter=Filter(
            wn_rad_s=2 * np.pi * sections.filter.natural_frequency_hz,
            zeta=sections.filter.damping,
            rows_per_s=sections.filter.rows_per_s,
        ),
        gates=Gates(
            condition_limit=gates.condition_limit,
            max_gap_s=max(_max_gap_s(sections, catalog), 2.5 * sections.source.average_s),
            hysteresis=gates.hysteresis,
            min_rows=gates.min_rows,
            max_sd_share=gates.max_sd_share,
            max_surprise=gates.max_surprise,
            recovery_s=gates.recovery_s,
            stale_s=gates.stale_s or math.inf,
        ),
        upkeep=_upkeep(sections),
        measured=measured,
        mode=next((signal.name for signal in signals if signal.kind == "mode"), NONE),
        form=sections.estimator.form,
        recent_blocks=sections.estimator.recent_blocks,
        pressure_period_s=_pressure_period_s(sections, catalog),
    )


def sums_of(model: Machine) -> tuple[RunningSum, ...]:
    """The running integral of a rate that is measured itself; () for all other plants."""
    if not model.measured:
        return ()
    column, rated = model.column(model.measured), max(e.rated_q_m3s for e in model.edges)
    return (RunningSum(model.signals[column], column, rated),)


def build_assembly(
    sections: Sections, model: Machine, catalog: Catalog | None, *, table: bool
) -> Assembly:
    """What the assembler needs for a CAN trace, or with `table` for the columns of a table."""
    used = [] if table else _used(sections, catalog)
    messages = tuple(_message(name, sections, catalog) for name in used)
    return Assembly(
        mode=CYCLE if table else _mode(sections, catalog),
        signals=tuple(_source(n, s, catalog, table) for n, s in _right(sections, catalog).items()),
        messages=messages,
        row_signal=model.measured or model.position,
        max_gap_s=_max_gap_s(sections, catalog),
        average_s=sections.source.average_s,
        ahead=_means_ahead(sections),
    )


def _means_ahead(sections: Sections) -> tuple[tuple[str, str], ...]:
    """What moves a state whose samples are means: what counts is its own mean from one to the next.

    Through two means the line is wrong by an eighth where it turns within a window.  A pressure
    lets oil pass in the same way, and stores by what it changes from mean to mean: it is both.
    """
    if not (sections.rate and sections.rate.state and sections.source.average_s):
        return ()
    commands = dict.fromkeys(u for part in sections.maps.values() for u in part.all_commands)
    ports = ((port, AHEAD + port) for port in sections.rate.ports)
    return (*((command, command) for command in commands), *ports)


def _with_means_ahead(
    signals: tuple[Signal, ...], ahead: tuple[tuple[str, str], ...]
) -> tuple[Signal, ...]:
    """The signals, those that are means ahead marked, and one more for each that is both."""
    by_name = {signal.name: signal for signal in signals}
    marked = {name: replace(by_name[of], name=name, is_ahead=True) for of, name in ahead}
    return tuple((by_name | marked).values())


def digest(value: object) -> str:
    """A hash of a declaration, exact to the last bit of each number."""
    return hashlib.sha256(_canonical(value).encode()).hexdigest()[:16]


def feed(assembly: Assembly, catalog: Catalog | None) -> tuple[object, ...]:
    """What turns frames into samples: roles, scales, offsets, signs, and the bits of each signal.

    Of the DBC only the signals that carry a role or protect them: a comment changes no sample.
    """
    if catalog is None:
        return (assembly,)
    bits = []
    for message in assembly.messages:
        carried = [s.signal for s in assembly.signals if s.message == message.name and s.signal]
        names = [*dict.fromkeys(carried), *(n for n in (message.counter, message.crc) if n)]
        layouts = catalog.layouts(message.name, names)
        matched = catalog.can_id(message.name), catalog.is_j1939(message.name)
        bits.append((matched, layouts.rows, layouts.firsts, layouts.codes))
    return assembly, tuple(bits)


def _canonical(value: object) -> str:
    if isinstance(value, np.ndarray):
        return _canonical(tuple(value.tolist()))
    if isinstance(value, tuple):
        return "(" + ",".join(_canonical(entry) for entry in value) + ")"
    if is_dataclass(value):
        parts = (f"{f.name}={_canonical(getattr(value, f.name))}" for f in fields(value))
        return type(value).__name__ + "(" + ",".join(parts) + ")"
    return value.hex() if isinstance(value, float) else repr(value)


def unit_of(signal: SignalSection, catalog: Catalog | None) -> Unit:
    """Unit of the raw signal, from the file or the DBC; only for checked sections."""
    name = signal.unit
    if name is None and catalog is not None and signal.message and signal.signal:
        name = catalog.signal(signal.message, signal.signal).unit
    unit = find_unit(name or "")
    assert unit is not None, "sections are checked before they are built"
    return unit


def _dbc(signal: SignalSection, catalog: Catalog | None) -> tuple[float, tuple[float, float]]:
    """Resolution and range of the DBC signal; 0 and infinite where it is none or says nothing."""
    everything = (-math.inf, math.inf)
    if catalog is None or not signal.message or not signal.signal or signal.constant is not None:
        return 0.0, everything
    result = catalog.signal(signal.message, signal.signal)
    step = 0.0 if result.is_float else abs(float(result.scale))
    low, high = result.minimum, result.maximum
    if low is None or high is None or not low < high:
        return step, everything
    return step, (float(low) - step / 2, float(high) + step / 2)


def _right(sections: Sections, catalog: Catalog | None) -> dict[str, SignalSection]:
    """The signals with the zeros that `rtid add` has found in their offsets."""
    right = dict(sections.signals)
    for name, bias_pa in sections.zeros_pa.items():
        if name in right:
            offset = (right[name].offset or 0.0) - bias_pa / unit_of(right[name], catalog).factor
            right[name] = right[name].model_copy(update={"offset": offset})
    return right


def _signal(name: str, signal: SignalSection, catalog: Catalog | None) -> Signal:
    unit = unit_of(signal, catalog)
    scale = 1.0 if signal.scale is None else signal.scale
    step, limits = _dbc(signal, catalog)
    ends = sorted(scale * limit + (signal.offset or 0.0) for limit in limits)
    kind = _kind(signal, unit)
    known = (0.0, float(MOST_MODE)) if kind == "mode" else (ends[0], ends[1])
    low, high = _to_si(signal.range or known, signal, unit)
    slope = _slope(signal, unit)
    resolution = abs(scale) * step if signal.resolution is None else signal.resolution
    return Signal(
        name=name,
        kind=kind,
        unit=_si_unit(kind, unit, signal) or _command_unit(unit),
        noise=slope * (signal.noise or signal.noise_seen or 0.0),
        resolution=slope * resolution,
        minimum=low,
        maximum=high,
    )


def _si_unit(kind: str, unit: Unit, signal: SignalSection) -> str | None:
    """Of a motor's position it is an angle's."""
    known = None if unit.dimension == "angle" and not signal.table else _SI_UNIT.get(kind)
    return known or _SI_OTHER.get(unit.dimension)


def _command_unit(unit: Unit) -> str:
    """A command's own unit, without a prefix: of mA it is A, of ‰ it is %."""
    if unit.factor == 1.0:
        return unit.name
    return next(known.name for known in units_of(unit.dimension) if known.factor == 1.0)


def _kind(signal: SignalSection, unit: Unit) -> str:
    other = OTHER if unit.dimension in OTHERS else ""
    return signal.kind or ("position" if signal.table else other or KINDS[unit.dimension])


def _slope(signal: SignalSection, unit: Unit) -> float:
    """SI change per change of the signal; of an angle table the median slope."""
    if signal.table is None:
        return unit.factor
    return float(np.median(np.abs(np.diff(signal.table.position_m) / np.diff(signal.table.angle))))


def _to_si(limits: tuple[float, float], signal: SignalSection, unit: Unit) -> tuple[float, float]:
    if signal.table is None:
        return unit.si(limits[0]), unit.si(limits[1])
    angle, position_m = np.array(signal.table.angle), np.array(signal.table.position_m)
    inside = np.clip(angle, limits[0], limits[1])
    values = np.interp(inside, angle, position_m)
    return float(values.min()), float(values.max())


def _source(
    name: str, signal: SignalSection, catalog: Catalog | None, column: bool
) -> SignalSource:
    unit = unit_of(signal, catalog)
    scale = 1.0 if signal.scale is None else signal.scale
    table = None
    if signal.table is not None:  # the table takes the raw signal: undo scale and offset
        raw = tuple((angle - (signal.offset or 0.0)) / scale for angle in signal.table.angle)
        table = (raw, signal.table.position_m)
        table = table if scale > 0 else (raw[::-1], signal.table.position_m[::-1])
    kind = _kind(signal, unit)
    return SignalSource(
        name=name,
        message="" if column else signal.message or "",
        signal=(signal.column if column else signal.signal) or "",
        factor=unit.factor * scale,
        offset=unit.si(signal.offset or 0.0),
        table=table,
        constant=None if signal.constant is None else unit.si(signal.constant),
        hold=signal.hold or ("zero" if kind in ("command", "mode") else "linear"),
        command=kind == "command",
        late_rows=signal.late_rows if column else 0,
    )


def _used(sections: Sections, catalog: Catalog | None) -> list[str]:
    """Messages that carry a signal, in the order of the file."""
    signals = sections.signals.values() if catalog else ()
    names = [s.message for s in signals if s.message and s.constant is None]
    return list(dict.fromkeys(names))


def _message(name: str, sections: Sections, catalog: Catalog | None) -> MessageSource:
    declared = sections.messages.get(name)
    known = catalog.message_source(name) if catalog else MessageSource(name, 0.0)
    if declared is None:
        return known
    given = declared.model_fields_set
    return MessageSource(
        name=name,
        period_s=declared.period_s or known.period_s,
        offset_s=declared.offset_s or 0.0,
        counter=declared.counter if "counter" in given else known.counter,
        crc=declared.crc if "crc" in given else known.crc,
        data_id=declared.data_id if "data_id" in given else known.data_id,
        channel=declared.channel,
        address=declared.address,
    )


def _mode(sections: Sections, catalog: Catalog | None) -> str:
    """As given, else one cycle if all messages share a period."""
    used = _used(sections, catalog)
    periods = {_message(name, sections, catalog).period_s for name in used}
    return sections.source.mode or (CYCLE if len(periods) <= 1 else MULTIRATE)


def _pressure_period_s(sections: Sections, catalog: Catalog | None) -> float:
    """Period of the slowest chamber pressure where samples come more often than pressures."""
    if _mode(sections, catalog) == CYCLE:
        return 0.0
    pressures = {chamber.pressure for chamber in sections.chambers.values()}
    measured = [s for n, s in sections.signals.items() if n in pressures and s.constant is None]
    return max(
        (_message(s.message, sections, catalog).period_s for s in measured if s.message),
        default=0.0,
    )


def _max_gap_s(sections: Sections, catalog: Catalog | None) -> float:
    """As given, else 50 ms, but never less than 2.5 periods of the slowest message."""
    if sections.gates.max_gap_s is not None:
        return sections.gates.max_gap_s
    periods = [_message(name, sections, catalog).period_s for name in _used(sections, catalog)]
    return max([MIN_GAP_S, *(2.5 * period for period in periods)])


def _upkeep(sections: Sections) -> Upkeep:
    given = sections.upkeep
    return Upkeep(
        every_s=given.every_s,
        forget_s=given.forget_s or math.inf,
        shared_forget_s=given.shared_forget_s or math.inf,
        innovation_sd=given.innovation_sd,
        innovation_rows=given.innovation_rows,
        folds=given.folds,
        history_s=given.history_s,
    )


def _open_in(edge: str, sections: Sections) -> tuple[int, ...]:
    """Numbers of the modes in which an edge may open; empty where no signal tells the mode."""
    numbers = next((s.numbers for s in sections.signals.values() if s.numbers), {})
    if not numbers:
        return ()
    return tuple(sorted(numbers[m] for m, edges in sections.modes.items() if edge in edges))


def _position(sections: Sections, signals: tuple[Signal, ...]) -> str:
    if sections.rate:
        return sections.rate.state or signals[-1].name
    named = sections.geometry.position if sections.geometry else None
    return named or next(signal.name for signal in signals if signal.kind == "position")


def _chambers(sections: Sections, signals: tuple[Signal, ...]) -> tuple[Chamber, ...]:
    """The pressure equations, or the one of a rate, which is called like its state."""
    if sections.rate is None:
        return tuple(_chamber(name, sections) for name in sections.chambers)
    state = next(s for s in signals if s.name == sections.rate.signal)
    known = sections.rate.disturbance or 0.0
    size = known * unit_of(sections.signals[state.name], None).factor
    unit = state.unit if sections.rate.measured else per_second(state.unit)
    ports = tuple(sections.rate.ports.items())
    return (Chamber(state.name, NONE, 1.0, 1, 0.0, size, unit, ports=ports),)


def per_second(unit: str) -> str:
    """The SI unit of a rate: m/s of m, m/s2 of m/s."""
    return f"{unit}2" if unit.endswith("/s") else f"{unit}/s"


def _edges(sections: Sections, signals: tuple[Signal, ...]) -> tuple[Edge, ...]:
    """The metering edges, or the maps of a rate."""
    if sections.rate is None:
        return tuple(_edge(name, edge, sections, signals) for name, edge in sections.edges.items())
    return tuple(e for name, part in sections.maps.items() for e in _map(name, part, sections))


def _map(name: str, part: MapSection, sections: Sections) -> Iterator[Edge]:
    """f(command, over): an edge whose pressure drop is the other signal; all sizes become SI.

    Further commands have edges that share the first one's map.
    """
    assert sections.rate is not None
    factor = unit_of(sections.signals[sections.rate.signal], None).factor
    over = unit_of(sections.signals[part.over], None) if part.over else None
    borders = NO_BORDERS if over is None else [over.si(v) for v in part.over_grid or ()]
    of = unit_of(sections.signals[part.all_commands[0]], None)
    along = part.u_grid_v or [of.si(v) for v in part.grid or ()]
    grid = Grid(np.array(along), np.array(borders))
    first, *others = part.all_commands
    edge = Edge(
        name=name, source=part.over or NONE, sink=NONE, command=first, direction=1,
        grid=grid, safe_band_v=-math.inf, rated_q_m3s=factor * part.rated,
        rated_dp_pa=float(np.abs(grid.dp_pa).max()), basis=part.basis,
        terms=BOTH if part.over else COMMAND_ONLY, signs=((sections.rate.signal, 1),),
    )  # fmt: skip
    yield edge
    for command in others:
        yield replace(edge, name=f"{name}_{command}", command=command, shares=name)


def _chamber(name: str, sections: Sections) -> Chamber:
    """V(x) = v0 + sign A x; the dead volume is what is left at the end where V is smallest."""
    chamber = sections.chambers[name]
    area_m2, goes_round = chamber.net_area_m2(), chamber.displacement_m3 is not None
    is_full = chamber.sign < 0 and not goes_round
    swept_m3 = area_m2 * sections.stroke_m if is_full else 0.0
    v0_m3 = chamber.dead_volume_m3 + swept_m3
    of = Chamber(name, chamber.pressure, area_m2, chamber.sign, v0_m3)
    return replace(of, is_constant=goes_round)


def _edge(name: str, edge: EdgeSection, sections: Sections, signals: tuple[Signal, ...]) -> Edge:
    given = sections.edge_defaults.model_dump(exclude_none=True)
    given |= edge.model_dump(exclude_none=True)
    command = next(signal.name for signal in signals if signal.kind == "command")
    return Edge(
        name=name,
        source=edge.source,
        sink=edge.sink,
        command=given.get("command", command),
        direction=edge.direction,
        grid=Grid(np.array(given["u_grid_v"]), np.array(given["dp_grid_pa"])),
        safe_band_v=given.get("safe_band_v", -math.inf),
        rated_q_m3s=given["rated_flow_m3s"],
        rated_dp_pa=given["rated_dp_pa"],
        basis=given.get("basis", TAYLOR),
        terms=given.get("terms", BOTH),
        modes=_open_in(name, sections),
    )
