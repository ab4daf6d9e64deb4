"""How the kernels compile; `firmware_bridge.kernel_cache` says where the result is kept."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from firmware_bridge.compiling import cache_folder, cached, uncounted
from firmware_bridge.compiling import part as linked

# x / 0 is inf, as in numpy: a check and a branch less per division
_OPTIONS = {"error_model": "numpy"}
_HERE = Path(__file__).parent
_FOLDER = cache_folder("kernels", _HERE, _HERE.glob("*.py"))


def kernel(function: Callable[..., Any]) -> Any:
    """Compile an entry point, called from Python; kept on disk where that is possible."""
    return cached(_FOLDER, function, **_OPTIONS)


def lean(function: Callable[..., Any]) -> Any:
    """Compile an entry point that allocates nothing: no references are counted."""
    return cached(_FOLDER, function, **_OPTIONS, **uncounted())


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that kernels call and Python does not; it allocates nothing."""
    return linked(function, **_OPTIONS)


def inlined(function: Callable[..., Any]) -> Any:
    """Insert a part into the kernels that call it: a call costs more than what it does."""
    return linked(function, forceinline=True, **_OPTIONS)
