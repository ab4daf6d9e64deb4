"""What makes kernels of functions, and whether this process needs them.

One that only shows what another has computed, as the server of the page, begins without numba: its
kernels stay the Python functions that they are.  What it calls all the same is slow, and right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

_IS_NEEDED = [True]


def do_without() -> None:
    """Compile nothing in this process; to be said before any module with kernels is imported."""
    _IS_NEEDED[0] = False


def cache_folder(name: str, beside: Path, sources: Iterable[Path]) -> Path | None:
    """As that of `kernel_cache`."""
    if not _IS_NEEDED[0]:
        return None
    from firmware_bridge import kernel_cache  # noqa: PLC0415 - numba is large

    return kernel_cache.cache_folder(name, beside, sources)


def cached(folder: Path | None, function: Callable[..., Any], **options: Any) -> Any:
    """As that of `kernel_cache`."""
    if not _IS_NEEDED[0]:
        return function
    from firmware_bridge import kernel_cache  # noqa: PLC0415 - numba is large

    return kernel_cache.cached(folder, function, **options)


def part(function: Callable[..., Any], **options: Any) -> Any:
    """As that of `kernel_parts`."""
    if not _IS_NEEDED[0]:
        return function
    from firmware_bridge import kernel_parts  # noqa: PLC0415 - numba is large

    return kernel_parts.part(function, **options)


def uncounted(is_so: bool = True) -> dict[str, bool]:
    """The option by which references are not counted, or are; none where numba has none."""
    if not _IS_NEEDED[0]:
        return {}
    from firmware_bridge import kernel_parts  # noqa: PLC0415 - numba is large

    return kernel_parts.UNCOUNTED if is_so else dict.fromkeys(kernel_parts.UNCOUNTED, True)
