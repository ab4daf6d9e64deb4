"""Replays that the tests of a module share: the same trace with the same project is learned once.

A replay is a function of its project and its trace, bit for bit, and what follows only reads it;
so each command of a module need not learn the record again.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rtid import beside, comparing
from rtid.project import Project
from rtid.replay import Progress, Replay


@pytest.fixture(scope="module", autouse=True)
def shared_replays() -> Iterator[None]:
    """Have compare, replay and export take a replay that was made before."""
    made: dict[tuple[object, ...], Replay] = {}
    replay_beside = beside.replay_beside

    def remembered(
        project: Project, path: Path, progress: Progress = _silent, bus_speed: float | None = None
    ) -> Replay:
        told = project.path.read_text(), repr(project.sections)
        key = (project.path, *told, path, path.stat().st_mtime_ns, bus_speed)
        if key not in made:
            made[key] = replay_beside(project, path, progress, bus_speed)
        return made[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(beside, "replay_beside", remembered)
        patch.setattr(comparing, "replay_beside", remembered)
        yield


def _silent(_text: str, _share: float) -> None:
    pass
