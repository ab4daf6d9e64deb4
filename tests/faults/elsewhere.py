"""Faults whose tests stand elsewhere, in `make soak`, or nowhere: the rows, what is shown, where.

    python -m tests.faults.elsewhere

prints the tests of other folders that `make faults` runs as well.
"""

from __future__ import annotations

ELSEWHERE: dict[int, tuple[str, tuple[str, ...]]] = {
    4: (
        "CRC: small errors always found, 2 in 1,000 of random ones pass",
        ("tests/bridge/test_e2e.py",),
    ),
    8: ("12 of 12 wrong units, signs and swaps named by `rtid check`", ("tests/test_check.py",)),
    12: ("adapter under another name found again within 3 s", ("tests/bridge/test_serial.py",)),
    13: (
        "10,000 bad bytes among 100,000 frames over a pty: at most one frame each, no wedge",
        ("tests/bridge/test_serial.py", "tests/bridge/test_slcan.py"),
    ),
    15: (
        "logs cut at 200 places: no wrong frame, exit code 3",
        ("tests/bridge/test_broken_logs.py",),
    ),
    16: ("200 flipped bits: one line or container each", ("tests/bridge/test_broken_logs.py",)),
    20: (
        "clock steps, drift, stamps that go back: one gap each, map within 0.2 %",
        ("tests/bridge/test_stamps.py", "tests/bridge/test_stamps_learning.py"),
    ),
    24: (
        "standstill, then motion: definite, no block moves; 10 h in `make campaign`",
        ("tests/estimator/test_upkeep.py", "tests/estimator/test_limits.py"),
    ),
    25: ("broken project files and DBCs: all errors named by key path", ("tests/test_project.py",)),
    26: ("attacks on the page", ("tests/ui/test_security.py",)),
    27: (
        "sending lives in one module, refuses unless armed; no test sends on a real bus",
        (
            "tests/bridge/test_serial_sink.py",
            "tests/test_layers.py",
            "tests/apply/test_on_board.py",
            "tests/apply/test_live.py",
        ),
    ),
    29: (
        "faults that are there at the start are named, and never learned; the whole table of 21 "
        "cases on drawn machines is in `make campaign`",
        ("tests/daemon/test_guard.py",),
    ),
    30: (
        "project A, B, A; accepted twice; gone back to: every state is there",
        ("tests/daemon/test_points.py",),
    ),
    31: ("projects that carry code: nothing runs without `rtid trust`", ("tests/test_trust.py",)),
    32: (
        "controllers that lie in each answer in turn: no done that is not true; absurd first maps",
        ("tests/apply/test_liars.py", "tests/apply/test_limits.py"),
    ),
    33: ("a small disk that is really full", ("tests/daemon/test_full_disk.py",)),
    34: ("containers that unpack to a thousand times their size", ("tests/bridge/test_bombs.py",)),
    35: ("FIFO, folder, link or nothing readable in the place of a file", (
        "tests/test_unreadable.py",
    )),
    37: (
        "loopback without the token, 24 pages, many sockets; 20 pages at once, no work on the "
        "loop over 50 ms",
        ("tests/ui/test_security.py", "tests/ui/test_many_pages.py"),
    ),
    38: ("log formats, several channels, broken logs", (
        "tests/bridge/test_text_logs.py",
        "tests/bridge/test_logs.py",
        "tests/bridge/test_channels.py",
    )),
    40: ("a step of the clock, a second daemon on one folder", (
        "tests/bridge/test_stamps.py",
        "tests/daemon/test_keeper.py",
    )),
}  # fmt: skip

IN_SOAK = {  # also, or alone, in `make soak`
    6: "changes of the plant, live",
    14: "a full bus for minutes",
    17: "50 kills, or RTID_SOAK_KILLS",
    21: "overload by four busy processes",
    28: "hours in minutes",
    37: "the loop beside an open page under load",
}

NOT_TESTED: dict[int, str] = {}


def files() -> list[str]:
    """The tests of other folders, each once."""
    return sorted({file for _, where in ELSEWHERE.values() for file in where})


if __name__ == "__main__":
    print(*files())
