"""A look-up table as a controller has it: flow over opening command and sqrt(dp), and its inverse.

Bilinear between nodes w (nu,) in V and s (ns,) in sqrt(Pa), flow (nu, ns) in m3/s rising with w;
beyond the nodes as at their edge.
"""

from __future__ import annotations

import math

import numpy as np

from rtid.kernels.jit import part
from rtid.plain import FloatArray


@part
def cell(nodes: FloatArray, x: float) -> tuple[int, float]:
    """The interval of nodes (n,) that holds x, and the share of it, 0 to 1, ends beyond."""
    i = min(max(int(np.searchsorted(nodes, x)) - 1, 0), len(nodes) - 2)
    share: float = (x - nodes[i]) / (nodes[i + 1] - nodes[i])
    return i, min(max(share, 0.0), 1.0)


@part
def signed_root(dp_pa: float) -> float:
    """Sign(dp) sqrt |dp|, sqrt(Pa)."""
    return math.copysign(math.sqrt(abs(dp_pa)), dp_pa)


@part
def flow_at(w_v: FloatArray, s: FloatArray, flow: FloatArray, w: float, dp_pa: float) -> float:
    """Flow, m3/s, at an opening command in V and a pressure drop in Pa.

    w_v (nu,) V, s (ns,) sqrt(Pa), flow (nu, ns) m3/s: the table.
    """
    i, a = cell(w_v, w)
    j, b = cell(s, signed_root(dp_pa))
    low: float = flow[i, j] + b * (flow[i, j + 1] - flow[i, j])
    high: float = flow[i + 1, j] + b * (flow[i + 1, j + 1] - flow[i + 1, j])
    return low + a * (high - low)


@part
def opening(w_v: FloatArray, s: FloatArray, flow: FloatArray, q_m3s: float, dp_pa: float) -> float:
    """The command, V, for a wanted flow > 0, m3/s; the highest where the valve cannot carry it.

    w_v (nu,) V, s (ns,) sqrt(Pa), flow (nu, ns) m3/s: the table.
    """
    j, b = cell(s, signed_root(dp_pa))
    low, high = 0, len(w_v) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if flow[middle, j] + b * (flow[middle, j + 1] - flow[middle, j]) < q_m3s:
            low = middle
        else:
            high = middle
    below: float = flow[low, j] + b * (flow[low, j + 1] - flow[low, j])
    above: float = flow[high, j] + b * (flow[high, j + 1] - flow[high, j])
    share = (q_m3s - below) / (above - below) if above > below else 1.0
    w: float = w_v[low] + min(max(share, 0.0), 1.0) * (w_v[high] - w_v[low])
    return w
