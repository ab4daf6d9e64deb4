"""A symmetric window along a series, in blocks that stay in the cache."""

from __future__ import annotations

from rtid.kernels.jit import kernel
from rtid.plain import FloatArray

BLOCK = 1024


@kernel
def correlate(values: FloatArray, weights: FloatArray, out: FloatArray) -> None:
    """out (n - m + 1,) = sum over j of weights[j] values[k + j]; values (n,), weights (m,)."""
    for first in range(0, len(out), BLOCK):
        last = min(first + BLOCK, len(out))
        part = out[first:last]
        part[:] = 0.0
        for j in range(len(weights)):
            w, moved = weights[j], values[first + j : last + j]
            for k in range(len(part)):
                part[k] += w * moved[k]
