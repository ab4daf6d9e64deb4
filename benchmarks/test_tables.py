"""The nodes of an exported table: one walk outwards from each, beside chords that are bisected.

Both follow an orifice's flow over command and pressure drop to 0.1 % of the largest, along either
axis, as `rtid export --bytes` asks of each valve a hundred times.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from benchmarks.interleave import Job, side_by_side
from rtid.estimator.orifice import root
from rtid.maps.lookup import refined
from rtid.plain import FloatArray

U_V = np.linspace(0.0, 10.0, 257)
DP_PA = np.linspace(-6e6, 6e6, 1001)
ALLOWED = 1e-3  # of the largest flow


def flow() -> FloatArray:
    """Flow (257, 1001), 1 at most: a dead band that ends softly, behind it an even gain."""
    gain = 0.5 * (U_V - 1.5 + np.sqrt((U_V - 1.5) ** 2 + 0.1))
    q = gain[:, None] * root(DP_PA)[None, :]
    return np.asarray(q / np.abs(q).max())


def bisected(x: FloatArray, exact: FloatArray, allowed: float) -> list[int]:
    """Indices among x (n,) of nodes between which exact (n, m) is linear to `allowed`."""
    at = [0]
    while at[-1] < len(x) - 1:
        start, good, bad = at[-1], at[-1] + 1, len(x)
        while bad - good > 1:
            tried = len(x) - 1 if bad == len(x) else (good + bad) // 2
            share = ((x[start : tried + 1] - x[start]) / (x[tried] - x[start]))[:, None]
            chord = exact[start] + share * (exact[tried] - exact[start])
            fits = np.abs(chord - exact[start : tried + 1]).max() <= allowed
            good, bad = (tried, bad) if fits else (good, tried)
        at.append(good)
    return at


def test_tables(benchmark: Any) -> None:
    q = flow()
    axes = {"command": (U_V, q), "pressure drop": (root(DP_PA), q.T)}
    jobs = []
    for name, (x, exact) in axes.items():
        walk = partial(refined, x, exact, ALLOWED, len(x) - 1)
        assert len(walk()) <= len(bisected(x, exact, ALLOWED))
        jobs.append(Job(f"along the {name}: one walk", walk))
        jobs.append(Job(f"along the {name}: chords bisected", partial(bisected, x, exact, ALLOWED)))
    side_by_side(benchmark, "Nodes of an exported table", "axis", jobs, jobs[0].name)
