"""A force that a pressure gives, F = A p: its project from tables of a pressure, a force, a motion.

A cylinder that is pulled or pushed on a stand.  The pressure may hardly change in one record, so
that nothing in it varies with the force: that they go together is told by their units and by

    1 - sum (F - A p)^2 / sum F^2.

The motion beside it is measured so that friction can be told, by its sign.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from firmware_bridge.sources import read_table
from rtid.estimator.noise import estimate_noise
from rtid.plain import FloatArray
from rtid.project.guess import RoleCandidate
from rtid.study.quick_drive import window_of

ROLE = "s"  # of the motion, beside u for the pressure and x for the force
PRESSED, FORCES, MOTIONS = ("pressure",), ("force",), ("length", "velocity")
GIVEN = 0.8  # share of the mean square of a force that its area times the pressure gives
ROOM = 1.2  # of the highest pressure in the records


@dataclass(frozen=True)
class Pressed:
    """The motion beside a force that a pressure gives, where there is one, and a window for it.

    noise: of the motion over such windows, in its own unit.
    """

    motion: RoleCandidate | None
    average_s: float = 0.0
    noise: float = 0.0

    @property
    def roles(self) -> dict[str, RoleCandidate]:
        """Who plays which role beside the pressure and the force."""
        return {ROLE: self.motion} if self.motion else {}


def share_of(pressure: FloatArray, force: FloatArray) -> float:
    """Share of forces' (n,) mean square that an area times pressures (n,) gives, any units."""
    whole = np.isfinite(pressure) & np.isfinite(force)
    p, f = pressure[whole], force[whole]
    power = float(p @ p) * float(f @ f)
    return float(p @ f) ** 2 / power if power > 0.0 else 0.0


def pressed_of(
    columns: Mapping[str, FloatArray], t_s: FloatArray, motions: Iterable[RoleCandidate]
) -> Pressed:
    """The motion that goes farthest for its noise, of columns (n,) at the instants t_s (n,)."""
    known = list(motions)
    windows = {c.name: window_of(t_s, columns[c.name]) for c in known}
    if not known:
        return Pressed(None)
    motion = min(known, key=lambda c: windows[c.name])
    window_s, step_s = windows[motion.name], float(np.nanmedian(np.diff(t_s)))
    noise = estimate_noise(t_s, columns[motion.name]).sd / np.sqrt(max(1.0, window_s / step_s))
    return Pressed(motion, window_s, float(noise))


def pressed_text(
    raw: dict[str, Any], pressed: Pressed, p: FloatArray, step_s: float, records: Iterable[Path]
) -> str:
    """TOML of the project, from that of any rate; p (n,): the pressure, in its own unit.

    records: others that it shall know the pressures of.
    """
    window_s, column = max(pressed.average_s, step_s), raw["signals"]["u"]["column"]
    there = (read_table(path).columns.get(column, p) for path in records)
    high, low = (max(float(np.nanmax(sign * v)) for v in (p, *there)) for sign in (1.0, -1.0))
    ends = [float(f"{ROOM * end:.3g}") for end in (-low, high)]
    if pressed.average_s:
        raw["source"]["average_ms"] = 1e3 * pressed.average_s
        raw["signals"]["x"]["resolution"] *= step_s / window_s
    for role, candidate in pressed.roles.items():
        noise = float(f"{pressed.noise:.3g}")
        raw["signals"][role] = {"column": candidate.name, "unit": candidate.unit, "noise": noise}
    grid = [min(ends[0], 0.0), 0.0, max(ends[1], 0.0)]
    raw["maps"]["f"] |= {"grid": list(dict.fromkeys(grid)), "basis": "proportional"}
    rows_hz = min(50.0, 1.0 / window_s)
    raw["filter"] = {"natural_frequency_hz": 0.1 * rows_hz, "rows_per_s": rows_hz}
    raw["gates"]["max_gap_ms"] = 1e3 * max(2.5 * window_s, 5.0 * step_s)
    head = ["# A force x that a pressure u gives, x = A u with an area A, written by rtid."]
    head += [f"# The motion {ROLE} beside it tells of friction."] * bool(pressed.motion)
    return "\n".join([*head, "", tomlkit.dumps(raw)])
