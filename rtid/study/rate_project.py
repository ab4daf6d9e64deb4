"""The project of a pair of `rtid.study.rate_pairs`: neutral, grid, what judges it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from firmware_bridge.sources import read_table
from firmware_bridge.sources.table import held
from rtid.plain import FloatArray
from rtid.project.guess import RoleCandidate, relative
from rtid.study.quick_drive import drive_text
from rtid.study.quick_pressed import pressed_text
from rtid.study.rate_pairs import RatePair
from rtid.study.spans import HELD_OUT_SHARE
from rtid.trace.neutral import held_out_from, slope_of
from rtid.trace.quick_source import Source
from rtid.units import COMMAND_DIMENSIONS, find_unit

BLOCKS = 13  # of the map
LEAST_ROWS, LEAST_VALUES = 15, 5  # samples that a block needs, and different commands
FAIR, ROOM = 0.05, 0.05  # share of the moving commands in a block; of the range, beyond it
HELD_OUT_OF_MEASURED, LONG_S = 0.5, 40.0  # of the motion: a measured rate has rows enough by then
GAP_STEPS = 5.0  # usual steps: a longer one is a gap
MAX_SD_SHARE = 0.05  # of the largest rate: known worse than this is not valid


def rate_text(
    name: str, path: Path, source: Source, pair: RatePair, more: Sequence[Path] = ()
) -> str:
    """TOML of the project of a pair, complete; more: further records that it is for."""
    table = read_table(path)
    t_s = table.seconds(source.keys["time_column"], source.keys["time_unit"])
    us = np.stack([held(t_s, table.columns[c.name]) for c in pair.commands], axis=1)
    x = table.columns[pair.state.name]
    whole = np.isfinite(t_s) & np.isfinite(us).all(axis=1) & np.isfinite(x)
    t_s, us, x = t_s[whole] - t_s[whole][0], us[whole] - _neutral(pair), x[whole]
    u = us.ravel()
    step_s = float(np.median(np.diff(t_s)))
    unit = find_unit(pair.command.unit)
    key = f"u_grid_{unit.key}" if unit else "u_grid_v"
    key = "grid" if unit and unit.dimension not in COMMAND_DIMENSIONS else key
    rows_hz = min(50.0, 1.0 / step_s)
    moved, size = x, np.abs(slope_of(t_s, x))
    if pair.is_measured:
        moved, size = us.sum(axis=1), np.abs(x) / us.shape[1]
    if pair.pressed and pair.pressed.motion:
        moved = table.columns[pair.pressed.motion.name][whole]
    is_long = pair.is_measured and t_s[-1] > LONG_S
    held_out = HELD_OUT_OF_MEASURED if is_long else HELD_OUT_SHARE
    split = held_out_from(t_s, moved, held_out)
    commands = {name: c for name, c in pair.roles.items() if name != "x"}
    raw: dict[str, dict[str, Any]] = {
        "project": {"name": name},
        "source": dict(source.keys),
        "signals": _signals(pair, commands, source.steps[pair.state.name]),
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


def _signals(
    pair: RatePair, commands: Mapping[str, RoleCandidate], step: float
) -> dict[str, dict[str, Any]]:
    """The columns of the commands and of what they drive; step: the smallest change of that."""
    offset: dict[str, Any] = {} if pair.is_measured else {"offset": "estimate"}
    signals = {
        name: {"column": command.name, "unit": command.unit} | offset
        for name, command in commands.items()
    }
    state: dict[str, Any] = {"column": pair.state.name, "unit": pair.state.unit}
    if _is_angle(pair.state):
        state["kind"] = "other"
    noise = 0.0 if pair.is_measured else "estimate"
    return signals | {"x": state | {"noise": noise, "resolution": step}}


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


def placed_near(text: str, records: Sequence[Path], file: Path) -> str:
    """The text of a project file with the places of its records relative to it, where they can."""
    for path in records:
        text = text.replace(f'"{path.resolve()}"', f'"{relative(path, file.parent)}"')
    return text


def of_records(text: str, records: Sequence[Path], held_out: Sequence[str]) -> str:
    """The project of the first record as that of several; held_out judge, or else the last one."""
    raw = tomlkit.parse(text)
    names = list(held_out) or [records[-1].name]
    raw["record"] = {"records": [str(path.resolve()) for path in records], "held_out": names}
    return tomlkit.dumps(raw)
