"""Lateness of the loop with the estimator in it, against cyclictest at the same priority.

`python -m benchmarks.loop [--rate 1000] [--slice 20] [--pairs 30]`; needs cyclictest (rt-tests) and
the right to SCHED_FIFO.  Slices alternate, because the host steals time at random and two peers of
one priority would block each other; the ratio of two quantiles is taken over all slices together,
its interval by resampling pairs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

PRIORITY = 60
MOST_US = 50_000
SHARES = (0.5, 0.99, 0.999, 0.9999)
Counts = NDArray[np.int64]


def cyclictest(rate_hz: float, seconds: float) -> Counts:
    """How often it woke so many whole microseconds late (MOST_US,)."""
    command = [
        "cyclictest", "-t1", f"-p{PRIORITY}", f"-i{round(1e6 / rate_hz)}", f"-D{round(seconds)}",
        "-m", "-q", f"-h{MOST_US}",
    ]  # fmt: skip
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    counts = np.zeros(MOST_US, np.int64)
    for line in said.splitlines():
        if line[:1].isdigit():
            late_us, count = line.split()[:2]
            counts[int(late_us)] += int(count)
    overflow = next(ln for ln in said.splitlines() if "Histogram Overflows" in ln)
    counts[-1] += int(overflow.split()[-1])
    return counts


def ours(rate_hz: float, seconds: float) -> tuple[Counts, dict[str, Any]]:
    """The same of our loop, in a process of its own, and what its ticks cost."""
    command = [sys.executable, "-m", "benchmarks.loop", "--child", str(rate_hz), str(seconds)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    measured = json.loads(said.splitlines()[-1])
    return np.array(measured["late"], np.int64), measured["told"]


def child(rate_hz: float, seconds: float) -> None:
    """Run the loop with frames, assembler, gates and estimator in each tick."""
    from rtid.daemon import realtime
    from rtid.daemon.loop import Loop
    from tests.faults.harness import FRAMES_PER_CYCLE, machine

    learner = machine().learner()
    pieces = list(machine().frames.chunks(FRAMES_PER_CYCLE))
    late, ticks = np.zeros(round(rate_hz * seconds), np.int64), iter(range(10**9))

    class Recorded(Loop):
        """Keeps each lateness to the nanosecond."""

        def _tick(self, due_ns: int, start_ns: int) -> int:
            k = self.total.ticks
            if k < len(late):
                late[k] = start_ns - due_ns
            else:
                self.stop()
            return super()._tick(due_ns, start_ns)

    def work(_now_ns: int) -> str:
        learner.push(pieces[next(ticks) % len(pieces)])
        return ""

    learner.push(machine().frames[:6000])
    realtime.settle_interpreter()
    realtime.sharpen_timer()
    realtime.lock_memory()
    if not realtime.promote(PRIORITY):
        sys.exit("no right to SCHED_FIFO")
    loop = Recorded(rate_hz, work)
    loop.run()
    counts = np.bincount(np.minimum(late // 1000, MOST_US - 1), minlength=MOST_US)
    cost = {f"p{100 * s:g}": loop.total.work.quantile_us(s) for s in (0.5, 0.99, 0.999)}
    answer = cost | {"overruns": loop.total.overruns, "causes": loop.total.causes}
    print(json.dumps({"late": counts.tolist(), "told": answer}))


def quantiles(counts: Counts) -> NDArray[np.float64]:
    """Lateness at SHARES, us: the upper edge of the bin."""
    total = np.cumsum(counts)
    return np.searchsorted(total, np.array(SHARES) * total[-1]) + 1.0


def main() -> None:
    """Alternate and report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--slice", type=float, default=20.0)
    parser.add_argument("--pairs", type=int, default=30)
    parser.add_argument("--child", nargs=2, type=float)
    wanted = parser.parse_args()
    if wanted.child:
        child(*wanted.child)
        return
    mine, theirs = [], []
    for k in range(wanted.pairs):
        theirs.append(cyclictest(wanted.rate, wanted.slice))
        counts, answer = ours(wanted.rate, wanted.slice)
        mine.append(counts)
        print(
            f"pair {k + 1}: cyclictest {quantiles(theirs[-1])}, rtid {quantiles(counts)}, {answer}"
        )
    a, b = np.array(mine), np.array(theirs)
    rng = np.random.default_rng(0)
    chosen = [rng.integers(0, len(a), len(a)) for _ in range(500)]
    ratios = np.array([quantiles(a[c].sum(0)) / quantiles(b[c].sum(0)) for c in chosen])
    low, high = np.quantile(ratios, [0.025, 0.975], axis=0)
    print(f"{wanted.rate:g} Hz, {len(a)} pairs of {wanted.slice:g} s, {os.cpu_count()} processors")
    for k, share in enumerate(SHARES):
        q = quantiles(a.sum(0))[k], quantiles(b.sum(0))[k]
        print(f"  p{100 * share:g}: rtid {q[0]:.0f} us, cyclictest {q[1]:.0f} us, "
              f"ratio {q[0] / q[1]:.2f} ({low[k]:.2f} .. {high[k]:.2f})")  # fmt: skip


if __name__ == "__main__":
    main()
