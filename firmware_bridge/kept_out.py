"""python-can's own MF4 support is kept out of our processes.

Where asammdf is installed it loads that and pandas, 0.6 s and 77 MB at each start, and we use it in
a process of its own (`firmware_bridge.sources.mf4`).  To be called before the first import of can.
"""

from __future__ import annotations

import sys


def keep_out_asammdf() -> None:
    """None in place of a module is what is not to be found; one that is loaded stays."""
    sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]


def let_in_asammdf() -> None:
    """Have it found again: python-can goes without it all the same."""
    if sys.modules.get("asammdf", sys) is None:
        del sys.modules["asammdf"]
