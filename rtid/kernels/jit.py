"""How the kernels compile, and where the result is kept.

numba's cache looks at the file of the function that is called, not at those of its callees: an old
binary would survive a change of them.  So the cache lies in a folder named by the digest of all
kernel sources.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import config, njit

# x / 0 is inf, as in numpy: a check and a branch less per division
_OPTIONS = {"error_model": "numpy"}
_HERE = Path(__file__).parent


def _digest() -> str:
    total = hashlib.sha256()
    for source in sorted(_HERE.glob("*.py")):
        total.update(source.read_bytes())
    return total.hexdigest()[:12]


def _cache_folder() -> Path | None:
    """Below NUMBA_CACHE_DIR, this package or the user's cache, wherever files can be written."""
    given = [Path(config.CACHE_DIR)] if config.CACHE_DIR else []
    for place in (*given, _HERE / "__pycache__", Path.home() / ".cache" / "rtid"):
        folder = place / f"kernels-{_digest()}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "writable").touch()
        except OSError:
            continue
        return folder
    return None


_FOLDER = _cache_folder()


def kernel(function: Callable[..., Any]) -> Any:
    """Compile an entry point, called from Python; kept on disk where that is possible."""
    return _cached(function)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that kernels call and Python does not."""
    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_OPTIONS)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Insert a function into the kernels that call it: a call costs more than what it does."""
    return _cached(function, inline="always")


def _cached(function: Callable[..., Any], **options: Any) -> Any:
    if _FOLDER is None:
        return njit(**_OPTIONS, **options)(function)
    before, config.CACHE_DIR = config.CACHE_DIR, str(_FOLDER)
    try:
        return njit(cache=True, **_OPTIONS, **options)(function)
    finally:
        config.CACHE_DIR = before
