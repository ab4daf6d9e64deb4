"""The page's server begins without a compiler, its worker reads without the estimator."""

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


READS = """
import sys
import rtid.ui.reader
heavy = "scipy.linalg", "rtid.estimator.estimator", "rtid.study.study"
print([name for name in heavy if name in sys.modules])
"""


def told(script: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120
    )
    return done.stdout


def test_signals_are_read_without_what_learns_from_them() -> None:
    assert told(READS).strip() == "[]"


def test_the_server_loads_no_numba_and_its_kernels_are_functions() -> None:
    assert told(SHOWS).split() == ["function", "False"]
