"""A start with damaged kernels: once more, with an empty cache that is gone afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

DAMAGED = """
import os
from pathlib import Path
from rtid.daemon.warm import AGAIN, CACHE, compiled

def make():
    if AGAIN not in os.environ:
        raise EOFError("damaged")
    return Path(os.environ[CACHE])

cache = compiled(make)
print(cache.is_dir(), cache)
"""


def test_its_own_cache_goes_when_it_ends(tmp_path: Path) -> None:
    """Each start with damaged kernels left its folder behind."""
    made = subprocess.run(
        [sys.executable, "-c", DAMAGED],
        env=os.environ | {"TMPDIR": str(tmp_path)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    was_there, folder = made.stdout.split()
    assert was_there == "True" and Path(folder).parent == tmp_path
    assert not list(tmp_path.iterdir())
