"""Faults whose tests stand elsewhere: the rows, what is shown there, and where."""

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
    26: ("attacks on the page", ("tests/browser",)),
    27: (
        "sending lives in one module, refuses unless armed; no test sends on a real bus",
        (
            "tests/bridge/test_serial_sink.py",
            "tests/test_layers.py",
            "tests/apply/test_on_board.py",
            "tests/apply/test_live.py",
        ),
    ),
}
