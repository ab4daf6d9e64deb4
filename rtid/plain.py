"""What everything shares: array types, unwatched progress, the one to-JSON, memory."""

from __future__ import annotations

import ctypes
import dataclasses
import math
import mmap
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Progress = Callable[[str, float], None]  # what is being done, and the share that is done
Key = tuple[str, str]  # an effect and where it sits
LARGE = 1 << 22  # bytes of an array for which numpy asks for huge pages
SPARED = 1 << 23  # bytes that half a matrix must have to be worth pages that are small, and slower
OWN = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}


def silent(_what: str, _share: float) -> None:
    """Progress that nobody watches."""


def plain(value: Any) -> Any:
    """Plain JSON types all the way: dataclasses as objects, arrays as lists, paths, NaN as null."""
    if dataclasses.is_dataclass(value):
        names = (field.name for field in dataclasses.fields(value))
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def give_back() -> None:
    """Give back to the system what was freed: glibc keeps what lies between small things that stay.

    Behind the diagnosis of ten minutes at 1 kHz that was 430 MB of 750; another library has none.
    """
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def half_used(n: int, kind: type = float) -> FloatArray:
    """Zeros (n, n) of a kind, any unit, of which one triangle is used: the other takes no memory.

    A huge page, which numpy asks for, would hold some of both.
    """
    if 4 * n * n < SPARED:
        return np.zeros((n, n), kind)
    size = np.dtype(kind).itemsize * n * n
    return np.ndarray((n, n), kind, buffer=mmap.mmap(-1, size, **OWN))
