"""How the simulator compiles; `firmware_bridge.kernel_cache` says where the result is kept.

Its functions call each other over files, and numba looks at the date of one alone: the folder is
named by what stands in all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from firmware_bridge.kernel_cache import cache_folder, cached

_HERE = Path(__file__).parent
_KERNELS = _HERE.parent / "kernels"
_SHARED = (_KERNELS / "look_up.py", _KERNELS / "control_law.py")  # what they call of the product
_FOLDER = cache_folder("sim", _HERE, [*_HERE.glob("*.py"), *_SHARED])


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function; x / 0 is inf, as in numpy."""
    return cached(_FOLDER, function, error_model="numpy")
