"""Made-up look-up tables: rising with the command, of any size."""

from __future__ import annotations

import numpy as np

from firmware_bridge import lookup
from firmware_bridge.lookup import Table


def a_table(
    nu: int = 20, ns: int = 15, seed: int = 0, direction: int = 1, safe_v: float = 1.0
) -> Table:
    """A valve that opens above safe_v, with flow along sqrt(dp), and cells of every status."""
    rng = np.random.default_rng(seed)
    w = np.concatenate([[safe_v], np.sort(rng.uniform(safe_v + 0.1, 10.0, nu - 1))])
    s = np.linspace(-500.0, 2600.0, ns) + 1000.0 / ns * rng.uniform(-1.0, 1.0, ns)
    gain = np.concatenate([[0.0], np.cumsum(rng.uniform(0.0, 1.0, nu - 1))])
    counts = np.round(32_000 * gain[:, None] / gain[-1] * s / np.abs(s).max())
    return Table(
        w.astype(np.float32),
        s.astype(np.float32),
        counts.astype(np.int16),
        rng.integers(0, lookup.CELL_STATUS, (nu - 1, ns - 1)).astype(np.uint8),
        float(np.float32(3e-8)),
        float(np.float32(safe_v)),
        direction,
    )
