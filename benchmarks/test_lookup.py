"""The controller's look-up in C: one flow, one command; wanted: a flow in at most 100 ns."""

from __future__ import annotations

import ctypes
import subprocess
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest

from benchmarks.compiler import pointer
from benchmarks.interleave import Job, side_by_side
from firmware_bridge.download import Image, Session, download
from firmware_bridge.lookup import image
from tests.bridge.controller import COMPILER, FILES, HERE, SOURCES, STRICT, Controller, Line
from tests.bridge.tables import a_table

N = 20_000
OPTIONS = ("-O2", "-shared", "-fPIC")  # as a firmware would: no -march, no -ffast-math
WANTED_NS = 100.0


def library() -> ctypes.CDLL:
    """The receiver and the look-up, as the tests compile them."""
    if COMPILER is None:
        pytest.skip("no compiler")
    built = Path(mkdtemp(prefix="rtid-bench-")) / "controller.so"
    sources = [str(HERE / "controller.c"), *(str(SOURCES / name) for name in FILES)]
    command = [COMPILER, *STRICT, *OPTIONS, f"-I{SOURCES}", *sources, "-lm", "-o", str(built)]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(built))


def jobs_of(nu: int, ns: int) -> list[Job]:
    """N look-ups at random points each, called from C in one loop."""
    table, controller = a_table(nu, ns), Controller(1)
    session = Session(Line(controller))
    session.open()
    download(session, {0: Image(image(table, 0))}, 1)
    rng, c = np.random.default_rng(0), library()
    u = rng.uniform(1.0, 10.0, N).astype(np.float32)
    dp = rng.uniform(0.0, 6e6, N).astype(np.float32)
    q = table.flow(u, dp)[0].astype(np.float32)
    out, status = np.zeros(N, np.float32), np.zeros(N, np.uint8)

    def run(function: Any, x: Any) -> None:
        function(
            controller._it, 0, ctypes.c_size_t(N),
            pointer(x), pointer(dp), pointer(out), pointer(status),
        )  # fmt: skip

    return [
        Job(f"flow, {nu} x {ns} nodes", partial(run, c.controller_flow, u), N),
        Job(f"command for a flow, {nu} x {ns} nodes", partial(run, c.controller_command, q), N),
    ]


def test_lookup(benchmark: Any) -> None:
    jobs = [job for size in ((20, 15), (50, 50), (115, 118)) for job in jobs_of(*size)]
    times = side_by_side(
        benchmark, "The controller's look-up in C", "look-up", jobs, jobs[0].name, rounds=31
    )
    for job in jobs:
        best_ns = 1e9 * min(times[job.name])  # the others were waited for by somebody else's work
        print(f"  {job.name}: {best_ns:.0f} ns at best, wanted {WANTED_NS:.0f}")
