"""How the maps that would be sent differ from those that the controller holds.

Both are bilinear between their nodes, and so is their difference between the nodes of both: its
largest value lies at one of these, exactly.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import isnan
from typing import Any

import numpy as np

from firmware_bridge.lookup import STATUS, Table
from rtid.model import Edge
from rtid.plain import FloatArray

VALID, SHUT = STATUS.index("valid"), STATUS.index("shut")


@dataclass(frozen=True)
class Difference:
    """New minus held map of one edge, SI; held = None: NaN, and 0 for the share.

    largest_m3s: with its sign, at (u_v, dp_pa); believed_m3s: the largest where one of the two
    stands on data, at (believed_u_v, believed_dp_pa); rms_m3s over the nodes of both;
    valid_before, valid: share of the plane above the safe band that stands on data.
    """

    edge: str
    rated_m3s: float
    largest_m3s: float
    u_v: float
    dp_pa: float
    believed_m3s: float
    believed_u_v: float
    believed_dp_pa: float
    rms_m3s: float
    valid_before: float
    valid: float

    @property
    def believed_percent(self) -> float:
        """Largest change where data stand behind, in per cent of the rated flow."""
        return 100.0 * abs(self.believed_m3s) / self.rated_m3s

    def as_json(self) -> dict[str, Any]:
        """All fields; None where nothing was held."""
        return {
            k: None if isinstance(v, float) and isnan(v) else v for k, v in asdict(self).items()
        }


def difference(edge: Edge, old: Table | None, new: Table) -> Difference:
    """What changes at one edge."""
    valid = valid_share(new)
    if old is None:
        nan, rated = float("nan"), edge.rated_q_m3s
        return Difference(edge.name, rated, nan, nan, nan, nan, nan, nan, nan, 0.0, valid)
    w = np.union1d(old.w_v, new.w_v).astype(float)
    s = np.union1d(old.s, new.s).astype(float)
    dp = s * np.abs(s)
    changed = new.flow(new.direction * w[:, None], dp)[0]
    changed = changed - old.flow(old.direction * w[:, None], dp)[0]
    middle_w, middle_s = 0.5 * (w[1:] + w[:-1]), 0.5 * (s[1:] + s[:-1])
    middle = middle_w[:, None], (middle_s * np.abs(middle_s))[None, :]
    codes = [table.flow(table.direction * middle[0], middle[1])[1] for table in (old, new)]
    believed = _touching((codes[0] == VALID) | (codes[1] == VALID))
    area = np.diff(w)[:, None] * np.diff(dp)
    corners = (changed[1:, 1:], changed[:-1, 1:], changed[1:, :-1], changed[:-1, :-1])
    square = sum(corner**2 for corner in corners) / 4
    return Difference(
        edge.name,
        edge.rated_q_m3s,
        *_largest(changed, w * new.direction, dp),
        *_largest(np.where(believed, changed, 0.0), w * new.direction, dp),
        float(np.sqrt(np.sum(square * area) / np.sum(area))),
        valid_share(old),
        valid,
    )


def valid_share(table: Table) -> float:
    """Share of the plane of commands and pressure drops, above the safe band, that is valid."""
    area = np.diff(table.w_v.astype(float))[:, None] * np.diff(table.dp_pa)
    is_open = table.status != SHUT
    return float(area[table.status == VALID].sum() / max(area[is_open].sum(), 1e-300))


def _touching(cells: np.ndarray) -> np.ndarray:
    """Nodes (n + 1, m + 1) at the corners of marked cells (n, m)."""
    nodes = np.zeros((cells.shape[0] + 1, cells.shape[1] + 1), bool)
    for i in (0, 1):
        for j in (0, 1):
            nodes[i : i + cells.shape[0], j : j + cells.shape[1]] |= cells
    return nodes


def _largest(changed: FloatArray, u: FloatArray, dp: FloatArray) -> tuple[float, float, float]:
    i, j = np.unravel_index(np.abs(changed).argmax(), changed.shape)
    return float(changed[i, j]), float(u[i]), float(dp[j])
