"""A map of acceleration over pedal and speed as the two tables of Autoware's vehicle interface.

    default, v_1, v_2, ...        accel_map.csv: throttle 0 to 1, rising downwards
    pedal,   a_11, a_12, ...      brake_map.csv: brake 0 to 1, falling downwards

One map f(u, v) over a signed pedal u, in per cent, throttle above zero and brake below, is both.
The interface inverts them: they must be monotone in the pedal, and have no holes.  So cells that
are not known take the value of the nearest known one of their speed, and the isotonic map closest
to the learned one is written; pedal_cells.csv says of every cell what was learned, and why another
value stands there.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtid.errors import RtidError
from rtid.estimator.flowmap import VALID, EdgeMap, FlowMap
from rtid.plain import FloatArray

ACCEL, BRAKE, CELLS = "accel_map.csv", "brake_map.csv", "pedal_cells.csv"
UNIT = "m/s2"
PERCENT = 100.0
MOVED = 1e-6  # m/s2: less is rounding
EMPTY_CELL = "no data"


@dataclass(frozen=True)
class PedalTable:
    """Accelerations over signed pedals (n,), 0 to 1 of either, and speeds (m,), m/s.

    learned, written (n, m), m/s2; reason (n, m): why what is written is not what was learned, "".
    """

    pedal: FloatArray
    speed: FloatArray
    learned: FloatArray
    written: FloatArray
    reason: NDArray[np.str_]

    def rows(self, sign: int) -> Iterator[list[float]]:
        """The rows of one pedal, +1 throttle or -1 brake, from 0 to its end."""
        at = np.flatnonzero(sign * self.pedal >= 0.0)
        for k in at[:: 1 if sign > 0 else -1]:
            yield [round(float(abs(self.pedal[k])), 6), *np.round(self.written[k], 6).tolist()]


def pedal_table(flowmap: FlowMap) -> PedalTable:
    """The table of the one map over pedal and speed.  RtidError where there is no such map."""
    edge = flowmap.edges[0]
    nodes, speed = np.unique(np.append(edge.grid.u_v, 0.0)), edge.grid.dp_pa
    if len(flowmap.edges) != 1 or edge.grid.shape[1] < 2 or not nodes[0] < 0.0 < nodes[-1]:
        raise RtidError(
            "no single map over a signed pedal and a speed",
            "one [maps.NAME] with over = the speed, its command from -100 (brake) to 100 %",
        )
    speed = speed[speed >= 0.0]
    u, v = np.meshgrid(nodes, speed, indexing="ij")
    learned = edge.flow(u, v)
    reason = _unknown(edge, u, v)
    known = reason == ""
    filled = np.where(known, learned, _nearest(learned, known, nodes, speed))
    from scipy.optimize import isotonic_regression  # noqa: PLC0415 - takes long to import

    written = np.stack([isotonic_regression(column).x for column in filled.T], axis=1)
    bent = known & (np.abs(written - learned) > MOVED)
    reason = np.where(bent, "made monotone in the pedal", reason)
    return PedalTable(nodes / PERCENT, speed, learned, written, reason)


def _unknown(edge: EdgeMap, u: FloatArray, v: FloatArray) -> NDArray[np.str_]:
    """Why a node (n, m), at u in per cent and v in m/s, is not known; "" where it is.

    A node is known where any block that meets there is.
    """
    eps_u, eps_v = (1e-6 * np.ptp(axis) for axis in (edge.grid.u_v, edge.grid.dp_pa))
    known = np.zeros(u.shape, bool)
    for du in (-eps_u, eps_u):
        for dv in (-eps_v, eps_v):
            known |= edge.status_at(u + du, v + dv) == VALID
    words = np.full(u.shape, "", dtype="<U120")
    i = np.clip(np.searchsorted(edge.grid.u_v, u, "right") - 1, 0, edge.grid.shape[0] - 1)
    j = np.clip(np.searchsorted(edge.grid.dp_pa, v, "right") - 1, 0, edge.grid.shape[1] - 1)
    for at in zip(*np.nonzero(~known), strict=True):
        words[at] = edge.reason.get((int(i[at]), int(j[at])), EMPTY_CELL)
    return words


def _nearest(
    learned: FloatArray, known: NDArray[np.bool_], pedal: FloatArray, speed: FloatArray
) -> FloatArray:
    """Per node (n, m) the value, m/s2, of the nearest known one: of its speed, else of any."""
    if not known.any():
        raise RtidError("no cell of the map is known", "`rtid check` says what driving is missing")
    i, j = np.nonzero(known)
    far = np.abs(pedal[:, None, None] - pedal[i]) / np.ptp(pedal)
    far = far + 10.0 * np.abs(speed[None, :, None] - speed[j]) / np.ptp(speed)
    at = far.argmin(axis=2)
    return np.asarray(learned[i[at], j[at]])


def write_pedals(path: Path, flowmap: FlowMap, origin: Mapping[str, Any]) -> PedalTable:
    """Write accel_map.csv, brake_map.csv and pedal_cells.csv into the folder of `path`.

    RtidError where the map is no acceleration over pedal and speed.
    """
    if origin.get("flow_unit") != UNIT:
        raise RtidError(f"{path}: the map is in {origin.get('flow_unit', 'm3/s')}", "in m/s2 only")
    table = pedal_table(flowmap)
    for name, sign in ((ACCEL, 1), (BRAKE, -1)):
        _write(path.with_name(name), [["default", *table.speed.tolist()], *table.rows(sign)])
    head = ["pedal", "speed_mps", "written_mps2", "learned_mps2", "reason"]
    cells = [
        [*np.round([table.pedal[k], table.speed[m], table.written[k, m], table.learned[k, m]], 6)]
        + [table.reason[k, m]]
        for k in range(len(table.pedal))
        for m in range(len(table.speed))
    ]
    _write(path.with_name(CELLS), [head, *cells])
    return table


def _write(path: Path, rows: list[list[Any]]) -> None:
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    path.write_text(text.getvalue(), "utf-8")
