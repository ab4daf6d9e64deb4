"""The page's server shows what its worker computes: it begins without a compiler."""

from __future__ import annotations

import subprocess
import sys

SHOWS = """
import sys
from firmware_bridge.compiling import do_without
do_without()
import rtid.ui.desk_views, rtid.ui.server
from rtid.kernels.following import follow_map
print(type(follow_map).__name__, "numba" in sys.modules)
"""


def test_the_server_loads_no_numba_and_its_kernels_are_functions() -> None:
    told = subprocess.run(
        [sys.executable, "-c", SHOWS], capture_output=True, text=True, check=True, timeout=120
    )
    assert told.stdout.split() == ["function", "False"]
