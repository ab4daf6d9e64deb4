"""How the bridge compiles: `kernel` is called from Python, `inlined` only from kernels.

Small functions are forced into their callers, because a call costs as much as decoding a signal.
Both keep the plain function as `.py_func`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Record = Any  # one row of a structured array
Records = NDArray[Any]  # a structured array; its dtype is named in the text
Integer = int | np.integer[Any]


def kernel(function: Callable[..., Any]) -> Any:
    """Compile an entry point; cached on disk."""
    return _cached(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a part of a kernel; always inlined."""
    return _cached(function, forceinline=True)


def _cached(function: Callable[..., Any], **options: Any) -> Any:
    """Keep the result on disk, where numba finds a folder that it may write to."""
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # no such folder: compile at each start
        return njit(**options)(function)
