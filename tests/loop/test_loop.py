"""The loop on a clock of its own: deadlines, overruns and their causes, without waiting."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from rtid.daemon.histogram import Histogram
from rtid.daemon.loop import Loop

MS = 1_000_000


class Clock:
    """A clock that moves by sleeping and by `spend`."""

    def __init__(self) -> None:
        self.now_ns = 5 * MS
        self.wakes_late_ns = 0

    def read(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9) + self.wakes_late_ns


def run(durations_ns: list[int], late_ns: list[int] | None = None, says: str = "") -> Loop:
    clock, starts, todo = Clock(), list[int](), list(durations_ns)
    late = list(late_ns or [0] * len(todo))

    def work(now_ns: int) -> str:
        starts.append(now_ns)
        clock.now_ns += todo.pop(0)
        clock.wakes_late_ns = late.pop(0)
        if not todo:
            loop.stop()
        return says

    loop = Loop(1000.0, work, clock.read, clock.sleep)
    loop.run()
    vars(loop)["starts"] = starts
    return loop


def test_ticks_stand_on_the_grid_however_long_the_work() -> None:
    loop = run([100_000, 900_000, 1, 999_999, 500_000])
    starts = vars(loop)["starts"]
    assert [(s - starts[0]) / MS for s in starts] == [0, 1, 2, 3, 4]
    assert loop.total.overruns == 0 and loop.total.ticks == 5


def test_an_overrun_skips_the_deadlines_that_passed_and_keeps_the_grid() -> None:
    loop = run([100_000, 3_500_000, 100_000, 100_000], says="handover")
    starts = vars(loop)["starts"]
    assert [(s - starts[0]) / MS for s in starts] == [0, 1, 5, 6]
    assert (loop.total.overruns, loop.total.skipped) == (1, 3)
    assert loop.total.causes == {"handover": 1}


def test_a_late_wake_up_is_told_from_long_work() -> None:
    """The work takes no processor time here: 2 ms late is "late", 2 ms away is "preempted"."""
    late = run([10, 10, 10], [2 * MS, 0, 0])
    assert late.total.causes == {"late": 1}
    away = run([10, 2 * MS, 10])
    assert away.total.causes == {"preempted": 1}


def test_every_tick_is_in_both_histograms() -> None:
    loop = run([300_000] * 50, [20_000] * 50)
    total = loop.total
    assert total.work.count == total.lateness.count == total.ticks == 50
    assert total.work.quantile_us(0.5) == pytest.approx(300, rel=0.11)
    assert total.lateness.max_us == pytest.approx(20)


def test_the_last_second_stands_beside_the_total() -> None:
    loop = run([300_000] * 1000 + [700_000] * 1000 + [1])
    assert loop.last_second.ticks == 1000
    assert loop.last_second.work.quantile_us(0.5) == pytest.approx(700, rel=0.11)
    assert loop.total.work.quantile_us(0.25) == pytest.approx(300, rel=0.11)


@pytest.mark.parametrize("share", [0.5, 0.99, 0.999, 1.0])
def test_quantiles_are_right_to_a_bin(share: float) -> None:
    durations = np.random.default_rng(0).lognormal(4, 2, 20_000)
    histogram = Histogram()
    for duration in durations:
        histogram.add(float(duration))
    truth = np.quantile(durations, share)
    assert truth * 0.99 <= histogram.quantile_us(share) <= 1.11 * truth


def test_threads_beside_a_promoted_loop_come_before_ordinary_work() -> None:
    """Else one that holds the interpreter is put aside by it; children stay ordinary."""
    script = """
import os, subprocess, sys, threading
from rtid.daemon.realtime import favour_threads, promote
if not promote(5):
    sys.exit("no")
end = threading.Event()
thread = threading.Thread(target=end.wait)
thread.start()
favour_threads()
policy, children = os.sched_getscheduler(thread.native_id), os.SCHED_RESET_ON_FORK
assert policy == os.SCHED_RR | children, policy
assert os.sched_getscheduler(0) == os.SCHED_FIFO | children, "the loop keeps its own"
child = [sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"]
assert int(subprocess.check_output(child)) == os.SCHED_OTHER
end.set()
"""
    command = [sys.executable, "-c", script]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    if found.stderr.strip() == "no":
        pytest.skip("this machine grants no real-time priority")
    assert found.returncode == 0, found.stderr


def test_only_the_calling_thread_is_promoted() -> None:
    """In a process of its own: the promotion would stay with the tests."""
    script = """
import os, threading
from rtid.daemon.realtime import promote, sharpen_timer, lock_memory
granted = promote(5)
seen = []
thread = threading.Thread(target=lambda: seen.append(os.sched_getscheduler(0)))
thread.start(); thread.join()
policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
assert granted == (policy == os.SCHED_FIFO)
assert seen == [os.SCHED_OTHER], seen
print(granted, sharpen_timer(), lock_memory())
"""
    found = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=os.environ, check=False
    )
    assert found.returncode == 0, found.stderr
    if "False" in found.stdout:
        pytest.skip(f"this machine grants (fifo, timer, memory): {found.stdout.strip()}")
