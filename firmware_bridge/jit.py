"""How the bridge compiles: `kernel` is called from Python, `inlined` only from kernels.

Small functions are forced into their callers, because a call costs as much as decoding a signal.
Both keep the plain function as `.py_func`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.compiling import cache_folder, cached, part, uncounted

Record = Any  # one row of a structured array
Records = NDArray[Any]  # a structured array; its dtype is named in the text
Integer = int | np.integer[Any]

_HERE = Path(__file__).parent
_FOLDER = cache_folder("bridge", _HERE, _HERE.rglob("*.py"))


def kernel(function: Callable[..., Any]) -> Any:
    """Compile an entry point; kept on disk where that is possible."""
    return cached(_FOLDER, function)


def inlined(function: Callable[..., Any]) -> Any:
    """Insert a part into the kernels that call it; it may allocate."""
    return part(function, forceinline=True, **uncounted(is_so=False))
