"""How the kernels compile; `firmware_bridge.kernel_cache` says where the result is kept."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from firmware_bridge.kernel_cache import cache_folder, cached

# x / 0 is inf, as in numpy: a check and a branch less per division
_OPTIONS = {"error_model": "numpy"}
_HERE = Path(__file__).parent
_FOLDER = cache_folder("kernels", _HERE, _HERE.glob("*.py"))


def kernel(function: Callable[..., Any]) -> Any:
    """Compile an entry point, called from Python; kept on disk where that is possible."""
    return cached(_FOLDER, function, **_OPTIONS)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that kernels call and Python does not."""
    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_OPTIONS)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Insert a function into the kernels that call it: a call costs more than what it does."""
    return cached(_FOLDER, function, inline="always", **_OPTIONS)
