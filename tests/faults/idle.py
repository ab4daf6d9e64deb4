"""A loop that does nothing, beside a daemon's: `python -m tests.faults.idle RATE_HZ PRIORITY`.

What it misses the machine has kept from it: a virtual one does not run all the time, and no program
on it can be more punctual.  Until SIGTERM; prints the share of its ticks that were overruns.
"""

from __future__ import annotations

import signal
import sys

from rtid.daemon import realtime
from rtid.daemon.loop import Loop


def main() -> None:
    """Loop, and say how punctual that was."""
    loop = Loop(float(sys.argv[1]), lambda _: "")
    signal.signal(signal.SIGTERM, lambda *_: loop.stop())
    realtime.settle_interpreter()
    realtime.sharpen_timer()
    realtime.promote(int(sys.argv[2]))
    loop.run()
    print(loop.total.overruns / loop.total.ticks)


if __name__ == "__main__":
    main()
