"""A small sample of `make fuzz`: nothing that is mutated may end in a traceback, hang or bomb."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SIZES = (
    "--projects", "16", "--dbcs", "12", "--nodes", "8", "--logs", "30", "--tables", "24",
    "--plants", "10", "--bombs", "0",
)  # fmt: skip


def test_a_sample_of_the_fuzz_finds_nothing(tmp_path: Path) -> None:
    """In a process of its own: it forks, which a test worker with threads cannot do."""
    command = [sys.executable, "-m", "tests.fuzz", "--seed", "7", "--out", str(tmp_path / "fuzz")]
    done = subprocess.run(
        [*command, *SIZES],
        cwd=Path(__file__).parents[2],
        env=os.environ | {"NUMBA_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
