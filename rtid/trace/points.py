"""Points in time of a learned state, to go back to: each a whole snapshot with its reason.

A point is written once and never again.  The older, the farther apart: where there are too many, or
too many bytes, the one goes whose neighbours are nearest to each other for its age.  The first and
the newest stay.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rtid.errors import RtidError
from rtid.trace.state_files import made_folder, name_also

FOLDER = "points"
REASONS = ("start", "publish", "accept", "alarm", "project", "fresh", "restore")
MOST_POINTS, MOST_BYTES = 60, 400 << 20
PAUSE_S = {"start": 600.0, "publish": 3600.0, "alarm": 60.0}  # between points of one reason
LEAST_AGE_S = 60.0  # of a point, when its distance to its neighbours is held against it
NAME = re.compile(r"(\d{10,})-(\w+)\.npz")


@dataclass(frozen=True)
class KeptPoint:
    """When it was written, why, and where it lies."""

    unix_s: float
    reason: str
    path: Path
    size_bytes: int


def points_of(folder: Path) -> list[KeptPoint]:
    """All points of the state folder of a restore key, oldest first."""
    points = []
    for path in (folder / FOLDER).glob("*.npz"):
        if (name := NAME.fullmatch(path.name)) and path.is_file():
            points.append(KeptPoint(1e-3 * int(name[1]), name[2], path, path.stat().st_size))
    return sorted(points, key=lambda point: point.unix_s)


def is_due(folder: Path, reason: str, now_s: float) -> bool:
    """Whether no point of that reason, one of REASONS, is young enough."""
    alike = [point.unix_s for point in points_of(folder) if point.reason == reason]
    return not alike or not 0.0 <= now_s - alike[-1] < PAUSE_S.get(reason, 0.0)


def keep(folder: Path, snapshot: Path, reason: str, now_s: float) -> KeptPoint:
    """Make a point of a whole snapshot file, and let the surplus go; OSError.

    It is another name of that file, which is only ever replaced: no byte is written again.
    """
    path = folder / FOLDER / f"{round(1e3 * now_s)}-{reason}.npz"
    made_folder(path.parent)
    name_also(snapshot, path)
    for point in surplus(points_of(folder), now_s):
        point.path.unlink()
    return KeptPoint(now_s, reason, path, path.stat().st_size)


def named(folder: Path, name: str) -> KeptPoint:
    """The one point whose name begins like this.  RtidError where none or several do."""
    points = points_of(folder)
    alike = [point for point in points if point.path.stem.startswith(name)]
    if len(alike) != 1:
        there = ", ".join(point.path.stem for point in points) or "none for this project file"
        problem = f"{len(alike)} points in time begin with" if alike else "no point in time is"
        raise RtidError(f"{folder}: {problem} {name!r}", f"there are: {there}")
    return alike[0]


def surplus(points: Sequence[KeptPoint], now_s: float) -> list[KeptPoint]:
    """The points that have to go, points in their order of time."""
    kept, gone = list(points), list[KeptPoint]()
    while len(kept) > 2 and (
        len(kept) > MOST_POINTS or sum(point.size_bytes for point in kept) > MOST_BYTES
    ):
        gone.append(kept.pop(_densest(kept, now_s)))
    return gone


def _densest(points: Sequence[KeptPoint], now_s: float) -> int:
    """Place of the point whose neighbours are nearest to each other for its age."""
    times = [point.unix_s for point in points]
    share = [
        (times[k + 1] - times[k - 1]) / max(LEAST_AGE_S, now_s - times[k])
        for k in range(1, len(times) - 1)
    ]
    return 1 + min(range(len(share)), key=share.__getitem__)
