"""What the system can do for a steady loop; each step returns whether it was granted.

The calling thread is promoted, and those beside it a little: what holds the interpreter must not be
put aside by the machine's other work.  Children and new threads start as ordinary ones, and what
hangs is stopped by the system after RUN_AWAY_S of computing without a pause.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import resource
import sys
import threading
from collections.abc import Iterator

RUN_AWAY_S = 2
BESIDE = 1  # priority of the other threads: before all that is not real-time
SWITCH_S = 0.5e-3  # another Python thread hands over the interpreter after so long
HASTY = -10  # nice, as the service file grants it: before all ordinary work of the machine
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4  # on fault: what is reserved costs nothing
PR_SET_TIMERSLACK = 29
M_ARENA_MAX, M_MMAP_THRESHOLD = -8, -3
LARGE_BYTES = 1 << 16  # from here on memory goes back to the system when it is given up

_libc = ctypes.CDLL(None, use_errno=True)


def promote(priority: int) -> bool:
    """SCHED_FIFO for this thread alone, 1 to 99."""
    with contextlib.suppress(OSError, ValueError):
        limit_us = RUN_AWAY_S * 1_000_000
        resource.setrlimit(RLIMIT_RTTIME, (limit_us, limit_us + 1_000_000))
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(priority))
        return True
    return False


RLIMIT_RTTIME: int = getattr(resource, "RLIMIT_RTTIME", 15)


def favour_threads() -> None:
    """SCHED_RR, below the loop's priority, for all threads that are ordinary ones still.

    They share the loop's interpreter and its locks: one of them that was put aside while it held
    either would hold up the loop, whatever priority that has.
    """
    for thread in threading.enumerate():
        with contextlib.suppress(OSError):
            number = thread.native_id or 0
            if number and os.sched_getscheduler(number) == os.SCHED_OTHER:
                policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
                os.sched_setscheduler(number, policy, os.sched_param(BESIDE))


def hasten(thread: int, is_real_time: bool = False) -> None:
    """Let a thread, of any process of this user, come before ordinary work, as far as granted.

    Beside a loop of real-time priority as one of those next to it: nice counts within a session or
    service alone, where the system groups its work by these.
    """
    policy, priority = os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(BESIDE)
    with contextlib.suppress(OSError):
        if is_real_time:
            os.sched_setscheduler(thread, policy, priority)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, thread, HASTY)


def give_way(thread: int, nice: int) -> None:
    """The end of that: an ordinary thread which lets other work come first."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    os.setpriority(os.PRIO_PROCESS, thread, nice)


@contextlib.contextmanager
def hastened() -> Iterator[None]:
    """The calling thread meanwhile, and the threads and processes that it starts."""
    thread = threading.get_native_id()
    before = os.getpriority(os.PRIO_PROCESS, thread)
    hasten(thread)
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, thread, before)


def share_arenas() -> None:
    """Let all threads allocate from two pools, not each from its own; before they are started.

    Large arrays stay out of the pools: between small ones that live on they would leave holes.
    A batch for the helper has 70 kB or more, and waits while that is busy.
    """
    _libc.mallopt(M_ARENA_MAX, 2)
    _libc.mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)


def lock_memory() -> bool:
    """No page of this process is ever written out, once it has been used."""
    return bool(_libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) == 0)


def sharpen_timer() -> bool:
    """Wake this thread when its time has come, not up to 50 us later."""
    return bool(_libc.prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0) == 0)


def settle_interpreter() -> None:
    """Take everything that exists out of the collector's sight, and share the interpreter finely.

    Collections go on for what is made from now on, which is little.
    """
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_S)
