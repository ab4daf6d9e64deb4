"""A pump that moves a cylinder or a motor without valves, dx/dt = D n: its project from a table.

D is the displacement over the area, one for each direction.  What the pump gives first fills what
lies behind the port under pressure: which port that is comes from the pressures and the speed.
Sensors' noise hides it at a controller's rate, so that samples are averaged: over windows T in
which the pressures change by far more than their means' noise,

    var(p(t + T) - p(t))  >  CLEAR * 2 sd^2 / n,     n samples in T.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import tomlkit

from rtid.estimator.noise import estimate_noise
from rtid.plain import FloatArray
from rtid.project.guess import RoleCandidate

WINDOWS_S = (0.01, 0.02, 0.05, 0.1, 0.2)
CLEAR = 20.0  # what is left of a noise's bias then is a twentieth
PORTS = ("p_a", "p_b")
ROOM = 1.2  # of the fastest turn in the record


@dataclass(frozen=True)
class Drive:
    """The pressures behind the ports, by role; which command puts each under pressure; a window."""

    roles: dict[str, RoleCandidate]
    ways: dict[str, int]
    average_s: float


def drive_of(
    columns: Mapping[str, FloatArray],
    t_s: FloatArray,
    command: RoleCandidate,
    guessed: Mapping[str, RoleCandidate],
) -> Drive:
    """The ports of a pump that turns at columns[command.name] (n,) at the instants t_s (n,)."""
    roles = {role: guessed[role] for role in PORTS if role in guessed}
    turns = np.sign(np.nan_to_num(columns[command.name]))
    levels = {role: float(np.nanmean(turns * columns[c.name])) for role, c in roles.items()}
    ways = dict(zip(roles, (1, -1), strict=False))
    if len(levels) == len(PORTS) and levels["p_a"] < levels["p_b"]:
        ways = {role: -way for role, way in ways.items()}
    windows = [window_of(t_s, columns[c.name]) for c in roles.values()]
    return Drive(roles, ways, max([0.0, *windows]))


def window_of(t_s: FloatArray, values: FloatArray) -> float:
    """The shortest window in which what values (n,) change by stands out of their noise, s.

    0: every sample does.
    """
    known = np.isfinite(values) & np.isfinite(t_s)
    t_s, values = t_s[known], values[known]
    step_s, noise = float(np.median(np.diff(t_s))), estimate_noise(t_s, values).sd
    for window_s in (step_s, *(w for w in WINDOWS_S if w >= 2.0 * step_s)):
        n = round(window_s / step_s)
        means = values[: len(values) // n * n].reshape(-1, n).mean(axis=1)
        if np.var(np.diff(means)) > CLEAR * 2.0 * noise**2 / n:
            return 0.0 if n == 1 else window_s
    return WINDOWS_S[-1]


def drive_text(raw: dict[str, Any], drive: Drive, n: FloatArray, step_s: float) -> str:
    """TOML of the project, from that of any rate; n (samples,): the speed, in its own unit."""
    window_s = max(drive.average_s, step_s)
    top = float(f"{ROOM * max(np.abs(n).max(), 1e-9):.3g}")
    if drive.average_s:
        raw["source"]["average_ms"] = 1e3 * drive.average_s
        for signal in ("x",):
            raw["signals"][signal]["resolution"] *= step_s / window_s
    raw["signals"]["u"].pop("offset")
    for role, candidate in drive.roles.items():
        raw["signals"][role] = {"column": candidate.name, "unit": candidate.unit}
    raw["rate"]["ports"] = drive.ways
    raw["maps"]["f"] |= {"grid": [-top, 0.0, top], "basis": "proportional"}
    rows_hz = min(50.0, 1.0 / window_s)
    raw["filter"] = {"natural_frequency_hz": 0.1 * rows_hz, "rows_per_s": rows_hz}
    raw["gates"]["max_gap_ms"] = 1e3 * max(2.5 * window_s, 5.0 * step_s)
    head = (
        "# A cylinder that a pump moves without valves, d x / dt = D n, written by rtid: D is the",
        "# displacement of a radian over the area, one for each direction; ports are the pressures",
        "# behind the pump, each with the way it turns to put it under pressure.",
    )
    return "\n".join([*head, "", tomlkit.dumps(raw)])
