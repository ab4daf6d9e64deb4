"""Which command moves which signal in a table without valves and chambers.

    d state / dt = f(command),   or   y = f(command),   y = sum of f over commands alike

The pair is told by units, by the words that both names share and by how much of the rate the
command explains.  An acceleration or a force is y itself, and so is a speed that follows its
command and whose rate does not, as a motor's on its stand; commands whose names differ in a number
share one map.  A speed of rotation that gives nearly all of the rate is a pump that drives
(`rtid.study.quick_drive`), a force beside a pressure and no command is an area's
(`rtid.study.quick_pressed`).
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from firmware_bridge.sources import read_table
from firmware_bridge.sources.table import held
from rtid.plain import FloatArray
from rtid.project.guess import ROLES, RoleCandidate, is_wanted, propose, with_unit
from rtid.study.quick_drive import Drive, drive_of
from rtid.study.quick_pressed import (
    FORCES,
    GIVEN,
    MOTIONS,
    PRESSED,
    Pressed,
    pressed_of,
    share_of,
)
from rtid.trace.neutral import neutral_of, slope_of
from rtid.trace.quick_source import Source
from rtid.units import COMMAND_DIMENSIONS, find_unit, words_of

MEASURED, FLOWING = ("acceleration", "force"), ("velocity",)  # forces over a velocity: a damper's
TURNING, DRIVEN = ("rotation",), 0.7  # share of the rate's variance that a pump's speed gives
SPEEDS, FOLLOWS = ("velocity", "rotation"), 0.7  # share of a speed that a command itself gives
STATES = ("length", "velocity", "angle", "rotation", "temperature")
DRIVES = {"u", "cmd", "command", "valve", "spool", "pwm", "duty", "motor", "throttle", "lever"}
MOVES = {"x", "pos", "position", "v", "speed", "velocity", "angle", "omega", "temp", "temperature"}
BINS = 24  # of the command, to see how much of the rate it explains
NUMBER = re.compile(r"[_ ]?\d+$")
MOST_LOOKED = 20_000  # samples by which a pair is judged
LEAST_SHARE = 0.1  # of the rate's variance that a command must explain


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
        words = (f"u={self.command.name}", f"x={self.state.name}")
        return " ".join(f"--role {shlex.quote(word)}" for word in words)

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
            if pair.share <= LEAST_SHARE and _is_speed(state):
                itself = _measured_pair(t_s, table.columns, command, (), state)
                pair = itself if itself.share > FOLLOWS else pair
            if pair.share > LEAST_SHARE or {"u", "x"} <= given.keys():
                alike = len(words_of(command.stem) & words_of(state.stem) - {"u", "x"})
                is_first = {first.get("u"), first.get("x")} == {command, state}
                made.append((alike, is_first, pair.share, pair))
        for state in _candidates(source.signals, given.get("x"), MEASURED, set(), "x"):
            group = alike_commands(command, source.signals)
            for more in dict.fromkeys((group, ())):
                pair = _measured_pair(t_s, table.columns, command, more, state)
                if pair.share > LEAST_SHARE:
                    made.append((0, False, pair.share, pair))
    for command in _candidates(source.signals, given.get("u"), FLOWING, set(), "v"):
        for state in _candidates(source.signals, given.get("x"), MEASURED, set(), "x"):
            pair = _measured_pair(t_s, table.columns, command, (), state)
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


def _is_speed(state: RoleCandidate) -> bool:
    unit = find_unit(state.unit)
    return unit is not None and unit.dimension in SPEEDS


def _measured_pair(
    t_s: FloatArray,
    columns: Mapping[str, FloatArray],
    command: RoleCandidate,
    more: tuple[RoleCandidate, ...],
    state: RoleCandidate,
) -> RatePair:
    """y as a sum of one piecewise linear map over all commands."""
    u = np.stack([held(t_s, columns[c.name]) for c in (command, *more)], axis=1)
    y = columns[state.name]
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
    u, x = held(t_s, columns[command.name]), columns[state.name]
    whole = np.isfinite(t_s) & np.isfinite(u) & np.isfinite(x)
    t_s, u, x = t_s[whole], u[whole], x[whole]
    rate = slope_of(t_s, x)
    edges = np.linspace(u.min(), u.max(), BINS + 1)[1:-1] if len(u) else np.zeros(0)
    at = np.digitize(u, edges)
    mean = np.bincount(at, rate, BINS) / np.maximum(np.bincount(at, minlength=BINS), 1)
    total = float(np.var(rate)) if len(rate) else 0.0
    share = 1.0 - float(np.var(rate - mean[at])) / total if total > 0 else 0.0
    return RatePair(command, state, share, neutral_of(t_s, u, x))
