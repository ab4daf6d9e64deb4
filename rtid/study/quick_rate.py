"""A table without pressures: which command moves which signal, and the project of its rate.

    d state / dt = f(command),   or   y = f(command),   y = sum of f over commands alike

The pair is told by units, by the words that both names share and by how much of the rate the
command explains; the neutral, the grid and the part that is held out come from the record.  An
acceleration or a force is y itself; commands whose names differ in a number share one map.  A speed
of rotation that gives nearly all of the rate is a pump that drives (`rtid.study.quick_drive`), a
force beside a pressure and no command is an area's (`rtid.study.quick_pressed`).
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from firmware_bridge.sources import read_table
from firmware_bridge.sources.table import to_samples
from rtid.compare.dead_band import DeadBand, dead_band, per_direction
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import INSUFFICIENT
from rtid.errors import RtidError
from rtid.estimator.flowmap import VALID, EdgeMap
from rtid.estimator.published import publish
from rtid.plain import FloatArray, Progress, plain, silent
from rtid.project import Project
from rtid.project.guess import ROLES, RoleCandidate, is_wanted, propose, relative, with_unit
from rtid.study.quick_drive import Drive, drive_of, drive_text
from rtid.study.quick_pressed import (
    FORCES,
    GIVEN,
    MOTIONS,
    PRESSED,
    Pressed,
    pressed_of,
    pressed_text,
    share_of,
)
from rtid.study.spans import HELD_OUT_SHARE
from rtid.study.study import RecordError, Study
from rtid.trace.neutral import held_out_from, neutral_of, neutrals, slope_of
from rtid.trace.quick_source import Source
from rtid.trace.table import declared
from rtid.units import COMMAND_DIMENSIONS, find_unit, words_of

SCHEMA = 1
MEASURED, FLOWING = ("acceleration", "force"), ("velocity",)  # forces over a velocity: a damper's
TURNING, DRIVEN = ("rotation",), 0.7  # share of the rate's variance that a pump's speed gives
STATES = ("length", "velocity", "angle", "rotation", "temperature")
DRIVES = {"u", "cmd", "command", "valve", "spool", "pwm", "duty", "motor", "throttle", "lever"}
MOVES = {"x", "pos", "position", "v", "speed", "velocity", "angle", "omega", "temp", "temperature"}
BINS = 24  # of the command, to see how much of the rate it explains
NUMBER = re.compile(r"[_ ]?\d+$")
MOST_LOOKED = 20_000  # samples by which a pair is judged
LEAST_SHARE = 0.1  # of the rate's variance that a command must explain
BLOCKS = 13  # of the map
LEAST_ROWS, LEAST_VALUES = 15, 5  # samples that a block needs, and different commands
FAIR, ROOM = 0.05, 0.05  # share of the moving commands in a block; of the range, beyond it
HELD_OUT_OF_MEASURED, LONG_S = 0.5, 40.0  # of the motion: a measured rate has rows enough by then
GAP_STEPS = 5.0  # usual steps: a longer one is a gap
MAX_SD_SHARE = 0.05  # of the largest rate: known worse than this is not valid


@dataclass(frozen=True)
class RatePair:
    """A command and the state that it moves, with units; neutral in the unit of the command.

    share: of the rate's variance that the command explains; delay is not looked for.  more: further
    commands with the same map.  is_measured: the state is what the map gives, not what it moves.
    drive: of a pump that moves it without valves; pressed: of a force that a pressure gives.
    """

    command: RoleCandidate
    state: RoleCandidate
    share: float
    neutral: float
    more: tuple[RoleCandidate, ...] = ()
    is_measured: bool = False
    drive: Drive | None = None
    pressed: Pressed | None = None

    @property
    def options(self) -> str:
        """What names this pair on the command line."""
        return f"--role u={self.command.name} --role x={self.state.name}"

    @property
    def commands(self) -> tuple[RoleCandidate, ...]:
        """All commands of the map."""
        return (self.command, *self.more)

    @property
    def roles(self) -> dict[str, RoleCandidate]:
        """Who plays which role: u, or u1, u2 ..., and x."""
        names = ["u"] if not self.more else [f"u{k + 1}" for k in range(len(self.commands))]
        known = dict(zip(names, self.commands, strict=True)) | {"x": self.state}
        beside = self.drive or self.pressed
        return known | (beside.roles if beside else {})

    @property
    def is_proportional(self) -> bool:
        """True where the map is a straight line through zero: nothing is bent to hide an effect."""
        return bool(self.drive or self.pressed)

    @property
    def kind(self) -> str:
        """Of plant, in words."""
        if self.pressed:
            return "a force that a pressure gives"
        return "a cylinder without valves" if self.drive else "a plant without pressures"

    @property
    def equation(self) -> str:
        """What is learned, in short."""
        given = "x" if self.is_measured else "d x / dt"
        if self.drive:
            return f"{given} = D u, moved by a pump, a D for each direction"
        if self.pressed:
            return f"{given} = A u, with an area A"
        if not self.more:
            return f"{given} = f(u)"
        return f"{given} = f(u1) + ... + f(u{len(self.commands)}), one map for all of them"


def pairs_of(path: Path, source: Source, given: Mapping[str, RoleCandidate]) -> list[RatePair]:
    """A pair for each command, the surest first; given: what the user has named."""
    table = read_table(path)
    t_s = table.seconds(source.keys["time_column"], source.keys["time_unit"])
    first = propose(source.signals)
    made = [(2, True, pair.share, pair) for pair in driven_pairs(path, source, given)]
    rank = 3 if "u" in given else -1  # a command comes before a pressure, unless that is named
    made += [(rank, False, pair.share, pair) for pair in pressed_pairs(path, source, given)]
    for command in _candidates(source.signals, given.get("u"), COMMAND_DIMENSIONS, DRIVES, "u"):
        for state in _candidates(source.signals, given.get("x"), STATES, MOVES, "x"):
            if command.name == state.name:
                continue
            pair = _pair(t_s, table.columns, command, state)
            if pair.share > LEAST_SHARE or {"u", "x"} <= given.keys():
                alike = len(words_of(command.stem) & words_of(state.stem) - {"u", "x"})
                is_first = {first.get("u"), first.get("x")} == {command, state}
                made.append((alike, is_first, pair.share, pair))
        for state in _candidates(source.signals, given.get("x"), MEASURED, set(), "x"):
            group = alike_commands(command, source.signals)
            for more in dict.fromkeys((group, ())):
                pair = _measured_pair(table.columns, command, more, state)
                if pair.share > LEAST_SHARE:
                    made.append((0, False, pair.share, pair))
    for command in _candidates(source.signals, given.get("u"), FLOWING, set(), "v"):
        for state in _candidates(source.signals, given.get("x"), MEASURED, set(), "x"):
            pair = _measured_pair(table.columns, command, (), state)
            if pair.share > LEAST_SHARE:
                made.append((0, False, pair.share, pair))
    best: list[RatePair] = []
    for *_, pair in sorted(made, key=lambda m: m[:3], reverse=True):
        taken = {command.name for other in best for command in other.commands}
        if pair.command.name not in taken:
            best.append(pair)
    return best


def driven_pairs(path: Path, source: Source, given: Mapping[str, RoleCandidate]) -> list[RatePair]:
    """What a pump moves without valves: by its speed, which gives nearly all of the rate."""
    table = read_table(path)
    t_s = table.seconds(source.keys["time_column"], source.keys["time_unit"])
    pairs = []
    for command in _candidates(source.signals, given.get("u"), TURNING, set(), "n"):
        unit = find_unit(command.unit)
        if unit is None or unit.dimension not in TURNING or is_wanted(command):
            continue
        for state in _candidates(source.signals, given.get("x"), ("length", "angle"), MOVES, "x"):
            pair = _pair(t_s, table.columns, command, state)
            if pair.share > DRIVEN:
                drive = drive_of(table.columns, t_s, command, propose(source.signals))
                pairs.append(replace(pair, neutral=0.0, drive=drive))
    return sorted(pairs, key=lambda pair: pair.share)[-1:]


def pressed_pairs(path: Path, source: Source, given: Mapping[str, RoleCandidate]) -> list[RatePair]:
    """The force that one area times a pressure gives, the surest; beside it what moves."""
    table = read_table(path)
    t_s, made = table.seconds(source.keys["time_column"], source.keys["time_unit"]), []
    for command in _of_dimension(_candidates(source.signals, given.get("u"), PRESSED, set(), "u")):
        for state in _candidates(source.signals, given.get("x"), FORCES, set(), "x"):
            share = share_of(table.columns[command.name], table.columns[state.name])
            if share > GIVEN and not is_wanted(command):
                made.append(RatePair(command, state, share, 0.0, is_measured=True))
    best = sorted(made, key=lambda pair: pair.share)[-1:]
    motions = list(_candidates(source.signals, None, MOTIONS, MOVES, "x")) if best else []
    return [replace(pair, pressed=pressed_of(table.columns, t_s, motions)) for pair in best]


def _of_dimension(candidates: Iterator[RoleCandidate]) -> Iterator[RoleCandidate]:
    """Those that are pressures: a user may have named anything for a role."""
    for candidate in candidates:
        unit = find_unit(candidate.unit)
        if unit is not None and unit.dimension in PRESSED:
            yield candidate


def alike_commands(
    command: RoleCandidate, signals: list[RoleCandidate]
) -> tuple[RoleCandidate, ...]:
    """The commands whose names differ from this one's in a number at their end alone."""
    kind = next(known for known in ROLES if known.name == "u")
    stem = NUMBER.sub("", command.stem)
    if stem == command.stem:
        return ()
    return tuple(
        replace(with_unit(s, kind), unit=command.unit)
        for s in signals
        if s.name != command.name and NUMBER.search(s.stem) and NUMBER.sub("", s.stem) == stem
    )


def _measured_pair(
    columns: Mapping[str, FloatArray],
    command: RoleCandidate,
    more: tuple[RoleCandidate, ...],
    state: RoleCandidate,
) -> RatePair:
    """y as a sum of one piecewise linear map over all commands."""
    u, y = np.stack([columns[c.name] for c in (command, *more)], axis=1), columns[state.name]
    whole = np.isfinite(u).all(axis=1) & np.isfinite(y)
    step = max(1, len(y) // MOST_LOOKED)
    u, y = u[whole][::step], y[whole][::step]
    share = 0.0
    if len(y) and np.ptp(u) > 0.0 and np.ptp(y) > 0.0:
        y = np.clip(y, *np.quantile(y, [0.01, 0.99]))  # a bump is not the command's
        knots = np.linspace(u.min(), u.max(), BINS // 2)
        phi = np.stack([np.interp(u, knots, hat).sum(axis=1) for hat in np.eye(len(knots))], axis=1)
        left = y - phi @ np.linalg.lstsq(phi, y, rcond=1e-6)[0]
        share = 1.0 - float(np.var(left) / max(np.var(y), 1e-300))
    return RatePair(command, state, share, 0.0, more, is_measured=True)


def _candidates(
    signals: list[RoleCandidate],
    given: RoleCandidate | None,
    dimensions: tuple[str, ...],
    words: set[str],
    role: str,
) -> Iterator[RoleCandidate]:
    if given is not None:
        yield given
        return
    kind = next((known for known in ROLES if known.name == role), ROLES[-1])
    for signal in signals:
        unit = find_unit(signal.unit)
        fits = unit.dimension in dimensions if unit else bool(words_of(signal.stem) & words)
        if fits and signal.high > signal.low and not (role == "x" and is_wanted(signal)):
            yield signal if signal.unit else with_unit(signal, kind)


def _pair(
    t_s: FloatArray, columns: Mapping[str, FloatArray], command: RoleCandidate, state: RoleCandidate
) -> RatePair:
    u, x = columns[command.name], columns[state.name]
    whole = np.isfinite(t_s) & np.isfinite(u) & np.isfinite(x)
    t_s, u, x = t_s[whole], u[whole], x[whole]
    rate = slope_of(t_s, x)
    edges = np.linspace(u.min(), u.max(), BINS + 1)[1:-1] if len(u) else np.zeros(0)
    at = np.digitize(u, edges)
    mean = np.bincount(at, rate, BINS) / np.maximum(np.bincount(at, minlength=BINS), 1)
    total = float(np.var(rate)) if len(rate) else 0.0
    share = 1.0 - float(np.var(rate - mean[at])) / total if total > 0 else 0.0
    return RatePair(command, state, share, neutral_of(t_s, u, x))


def rate_text(
    name: str, path: Path, source: Source, pair: RatePair, more: Sequence[Path] = ()
) -> str:
    """TOML of the project of a pair, complete; more: further records that it is for."""
    table = read_table(path)
    t_s = table.seconds(source.keys["time_column"], source.keys["time_unit"])
    us = np.stack([table.columns[c.name] for c in pair.commands], axis=1)
    x = table.columns[pair.state.name]
    whole = np.isfinite(t_s) & np.isfinite(us).all(axis=1) & np.isfinite(x)
    t_s, us, x = t_s[whole] - t_s[whole][0], us[whole] - _neutral(pair), x[whole]
    u = us.ravel()
    step_s = float(np.median(np.diff(t_s)))
    unit = find_unit(pair.command.unit)
    key = f"u_grid_{unit.key}" if unit else "u_grid_v"
    key = "grid" if unit and unit.dimension not in COMMAND_DIMENSIONS else key
    rows_hz = min(50.0, 1.0 / step_s)
    state: dict[str, Any] = {"column": pair.state.name, "unit": pair.state.unit}
    if _is_angle(pair.state):
        state["kind"] = "other"
    state |= {"noise": "estimate", "resolution": source.steps[pair.state.name]}
    moved, size = x, np.abs(slope_of(t_s, x))
    if pair.is_measured:
        state["noise"], moved, size = 0.0, us.sum(axis=1), np.abs(x) / us.shape[1]
    if pair.pressed and pair.pressed.motion:
        moved = table.columns[pair.pressed.motion.name][whole]
    is_long = pair.is_measured and t_s[-1] > LONG_S
    held_out = HELD_OUT_OF_MEASURED if is_long else HELD_OUT_SHARE
    split = held_out_from(t_s, moved, held_out)
    commands = {name: c for name, c in pair.roles.items() if name != "x"}
    offset: dict[str, Any] = {} if pair.is_measured else {"offset": "estimate"}
    raw: dict[str, dict[str, Any]] = {
        "project": {"name": name},
        "source": dict(source.keys),
        "signals": {
            **{
                name: {"column": command.name, "unit": command.unit} | offset
                for name, command in commands.items()
            },
            "x": state,
        },
        "rate": {"measured" if pair.is_measured else "state": "x"},
        "maps": {
            "f": {
                **({"commands": list(commands)} if pair.more else {"command": "u"}),
                key: _grid_of_measured(us) if pair.is_measured else _grid(u),
                "rated": _three(max(float(np.quantile(size, 0.99)), 1e-9)),
                "basis": "blended",
            }
        },
        "filter": {"natural_frequency_hz": _three(0.1 * rows_hz), "rows_per_s": _three(rows_hz)},
        "gates": {"max_gap_ms": _three(1e3 * GAP_STEPS * step_s), "max_sd_share": MAX_SD_SHARE},
        "record": {
            "identification_s": [0.0, split],
            "validation_s": [split, float(t_s[-1]) + step_s],
        },
    }
    if pair.pressed:
        return pressed_text(raw, pair.pressed, u, step_s, more)
    if pair.is_measured:
        head = [f"# A plant without pressures, {pair.equation}, written by rtid"]
        return "\n".join([*head, "", tomlkit.dumps(raw)])
    if pair.drive:
        return drive_text(raw, pair.drive, u, step_s)
    head = [
        "# A plant without pressures, d x / dt = f(u), written by rtid: u counts from its neutral",
        f"# ({pair.neutral:.6g} {pair.command.unit} here), which is found anew in every table.",
    ]
    return "\n".join([*head, "", tomlkit.dumps(raw)])


def _neutral(pair: RatePair) -> float:
    return pair.neutral if np.isfinite(pair.neutral) else 0.0


def _is_angle(signal: RoleCandidate) -> bool:
    unit = find_unit(signal.unit)
    return unit is not None and unit.dimension == "angle"


def _grid(u: FloatArray) -> list[float]:
    """Borders of the map: even, the neutral in the middle of a block, room for it to move.

    A block that knows one command alone, an end stop, would bend freely beside it: it joins the
    next one towards the neutral.
    """
    step = max(float(np.ptp(u)), 1e-9) / BLOCKS
    low, high = np.ceil(-u.min() / step), np.ceil(u.max() / step)
    below = _joined(-u, [step * (k + 0.5) for k in range(int(max(low, 0.0)) + 1)])
    above = _joined(u, [step * (k + 0.5) for k in range(int(max(high, 0.0)) + 1)])
    return [*(-border for border in reversed(below)), *above]


def _grid_of_measured(us: FloatArray) -> list[float]:
    """Borders between which each block holds a fair share of the commands (n, m) that move.

    A command that rests at one end of its range has a narrow block there: at rest a machine may
    stand against a floor or a stop, which bends no map beside it then.
    """
    moving = us[1:][np.diff(us, axis=0) != 0.0]
    low, high = float(us.min()), float(us.max())
    room = ROOM * (high - low)
    rests = [float(np.mean(us == end)) > FAIR for end in (low, high)]
    inside = low + room * rests[0], high - room * rests[1]
    borders = np.linspace(inside[0], inside[1], BLOCKS + 1).tolist()
    first, *between, last = _joined(moving, borders, max(LEAST_ROWS, round(FAIR * len(moving))))
    below = [low - room] + [first] * rests[0]
    above = [last] * rests[1] + [high + room]
    return [round(border, 9) for border in (*below, *between, *above)]


def _joined(u: FloatArray, borders: list[float], least: int = LEAST_ROWS) -> list[float]:
    """Those borders (m,) from the neutral outwards between which enough commands were sent."""
    kept = borders[:1]
    for border in borders[1:]:
        inside = u[(u > kept[-1]) & (u <= border)]
        if len(inside) >= least and len(np.unique(inside)) >= LEAST_VALUES:
            kept.append(border)
    if len(kept) > 1:
        kept[-1] = borders[-1]
    elif len(borders) > 1:
        kept.append(borders[-1])
    return [round(border, 9) for border in kept]


def _three(value: float) -> float:
    return float(f"{value:.3g}")


def no_plant(path: Path, signals: list[RoleCandidate]) -> RtidError:
    """What a table has, what each kind of plant would need, and the command that goes on."""
    there = ", ".join(f"{c.name} [{c.unit or '?'}]" for c in signals[:20]) or "nothing"
    lines = (
        f"{path}: no plant is told by the names and units of its columns. It has: {there}.",
        "A cylinder with valves needs the command of the valves (u), the position of the piston (x)"
        " and the pressures of both chambers (p_a, p_b).",
        "A plant without pressures needs a command (u, in V, A, % or PWM) and what it moves (x: a "
        "position, speed, angle or temperature), which must follow the command in this record.",
        "A plant whose equations you know needs these in a file: `rtid refit PLANT.toml TABLE`.",
    )
    return RtidError("\n".join(lines), "name the columns: rtid quick FILE --role u=COLUMN "
                     "--role x=COLUMN (and p_a, p_b where there are pressures)")  # fmt: skip


@dataclass(frozen=True)
class QuickRate:
    """What a table without pressures tells: the pair that was looked at, others, the diagnosis.

    text: the project file; bands: dead band (low, high) about the neutral and gains (below, above)
    by map, in SI, NaN where the map does not tell; ranges: lowest and highest command that a map is
    known at, and what it gives there, SI.  Of several records: their files, the neutral of the
    command in each, where one is looked for, and what the model leaves of each.
    """

    path: Path
    pair: RatePair
    others: tuple[RatePair, ...]
    text: str
    diagnosis: Diagnosis
    bands: dict[str, DeadBand]
    ranges: dict[str, tuple[float, float, float, float]]
    unused: tuple[str, ...]
    unit: str
    command_unit: str
    records: tuple[Path, ...] = ()
    neutrals: tuple[float, ...] = ()
    errors: tuple[RecordError, ...] = ()

    @property
    def is_enough(self) -> bool:
        """Whether there is a verdict that the data can bear."""
        return self.diagnosis.verdict != INSUFFICIENT

    @property
    def next_command(self) -> str:
        """What to do now."""
        held_out = [f"--held-out {error.path.name}" for error in self.errors if error.is_held_out]
        words = [*map(str, self.records or [self.path]), self.pair.options, *held_out]
        return f"rtid quick {' '.join(words)} --save machine.toml"

    def text_for(self, file: Path) -> str:
        """The project as it is written to a file: its records relative to it where they can be."""
        text = self.text
        for path in self.records:
            text = text.replace(f'"{path.resolve()}"', f'"{relative(path, file.parent)}"')
        return text

    def as_json(self) -> dict[str, Any]:
        """Plain JSON types."""
        pairs = [{"u": p.command.name, "x": p.state.name, "share": p.share} for p in self.others]
        words: dict[str, Any] = plain(
            {
                "schema": SCHEMA,
                "file": str(self.path),
                "plant": "rate",
                "roles": {name: asdict(role) for name, role in self.pair.roles.items()},
                "neutral": self.pair.neutral,
                "neutrals": self.neutrals,
                "others": pairs,
                "unused": list(self.unused),
                "maps": {name: asdict(band) for name, band in self.bands.items()},
                "diagnosis": self.diagnosis.as_json(),
                "next": self.next_command,
            }
            | ({"records": [asdict(error) for error in self.errors]} if self.errors else {})
        )
        return words


def known_range(edge: EdgeMap) -> tuple[float, float, float, float] | None:
    """Lowest and highest command between which a map is known, and what it gives; None: nowhere."""
    at = np.flatnonzero((edge.status == VALID).any(axis=1))
    if not len(at):
        return None
    u = edge.grid.u_v
    ends = 0.5 * np.array([u[at[0]] + u[at[0] + 1], u[at[-1]] + u[at[-1] + 1]])
    first, last = edge.flow(ends, np.zeros(2))
    return float(ends[0]), float(ends[1]), float(first), float(last)


def _of_records(text: str, records: Sequence[Path], held_out: Sequence[str]) -> str:
    """The project of the first record as that of several; held_out judge, or else the last one."""
    raw = tomlkit.parse(text)
    names = list(held_out) or [records[-1].name]
    raw["record"] = {"records": [str(path.resolve()) for path in records], "held_out": names}
    return tomlkit.dumps(raw)


def quick_rate(
    path: Path,
    source: Source,
    given: Mapping[str, RoleCandidate],
    progress: Progress = silent,
    more: Sequence[Path] = (),
    held_out: Sequence[str] = (),
) -> QuickRate:
    """Judge a table without pressures.  RtidError, with a page of help, where no command moves.

    more: further records of the same fit; held_out: names of those that judge, else the last one.
    """
    if source.periods_ms or "time_column" not in source.keys:
        raise no_plant(path, source.signals)
    pairs = pairs_of(path, source, given)
    if not pairs:
        raise no_plant(path, source.signals)
    pair, *others = pairs
    text, records = rate_text(path.stem or "machine", path, source, pair, more), (path, *more)
    if more:
        text = _of_records(text, records, held_out)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "machine.toml"
        file.write_text(text, "utf-8")
        study = Study(file, records, progress)
        diagnosed = study.diagnosed
        found = diagnosed.diagnosis.found
        for effect in found if pair.is_proportional else found[:1]:  # the maps are those beside it
            with suppress(RtidError):
                study.add(f"{effect.effect}:{effect.where}", force=True)
        errors, at_rest = study.record_errors, _at_rest(study.project, records)
        model, flowmap, text = study.machine, publish(study.fit.solution), file.read_text("utf-8")
    used = {role.name for role in pair.roles.values()}
    unused = tuple(s.name for s in source.signals if s.name not in used)
    gains = per_direction if pair.is_proportional else dead_band
    bands = {edge.name: gains(edge) for edge in flowmap.edges}
    units = model.chambers[0].unit, model.signals[model.column(model.edges[0].command)].unit
    ranges = {edge.name: known for edge in flowmap.edges if (known := known_range(edge))}
    said = diagnosed.diagnosis
    several = records if more else ()
    seen = said, bands, ranges, unused
    return QuickRate(path, pair, tuple(others), text, *seen, *units, several, at_rest, errors)


def _at_rest(project: Project, records: Sequence[Path]) -> tuple[float, ...]:
    """The neutral of the first command in each record, in its own unit; none where it has none."""
    samples = [to_samples(*declared(project, read_table(path)))[0] for path in records]
    return tuple(u for each in samples for u in list(neutrals(project, each).values())[:1])
