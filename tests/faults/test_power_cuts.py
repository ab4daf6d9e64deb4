"""The power fails between any two calls of a save: nothing is torn, nothing saved is lost."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from rtid.errors import RtidError
from rtid.estimator.estimator import Estimator
from rtid.project import history, load
from rtid.project.history import ADD, Change
from rtid.trace import snapshot, state_files
from rtid.trace.snapshot import Generations, SnapshotError
from tests.faults.conftest import Figure
from tests.faults.harness import machine
from tests.faults.power import Disk, laid_out, watched

SAVES = 3


def saved(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    """A few saves, each with a baseline, under the shim."""
    generations, estimator = Generations(folder, machine().project.digest), small()
    with watched(folder, monkeypatch) as disk:
        for serial in range(1, SAVES + 1):
            generations.save(estimator)
            disk.acknowledged = serial
            generations.save_baseline(estimator, {"serial": serial})
    return disk


def small() -> Estimator:
    """One that has seen nothing: what is in the file does not matter here."""
    estimator = Estimator(machine().project.model)
    estimator.history = None
    return estimator


def torn_and_lost(disk: Disk, folder: Path) -> tuple[int, int]:
    """Cuts that leave a torn file under its final name, and that lose what was acknowledged."""
    torn = lost = 0
    for acknowledged, left in unlike(disk):
        laid_out(left, folder)
        serials = [0]
        for path in folder.rglob("*.npz"):
            try:
                serials.append(int(snapshot._read(path)[0]["serial"]))
            except SnapshotError:
                torn += 1
        lost += max(serials) < acknowledged
    return torn, lost


def unlike(disk: Disk) -> list[tuple[int, dict[str, bytes]]]:
    """Each state of the disk once, with the most that was acknowledged by then."""
    found: dict[tuple[tuple[str, bytes], ...], int] = {}
    for acknowledged, left in disk.cuts:
        key = tuple(sorted(left.items()))
        found[key] = max(acknowledged, found.get(key, 0))
    return [(acknowledged, dict(key)) for key, acknowledged in found.items()]


def test_row_33_power_cuts_while_saving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figure: Figure
) -> None:
    disk = saved(made(tmp_path / "disk"), monkeypatch)
    torn, lost = torn_and_lost(disk, tmp_path / "left")
    print(f"{len(unlike(disk))} states of the disk at {len(disk.cuts)} cuts")
    assert len(unlike(disk)) > 5 * SAVES
    figure(33, "snapshots torn by a power cut at any call", torn, 0)
    figure(33, "acknowledged snapshots lost", lost, 0)


def made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def in_place(path: Path, content: bytes) -> None:
    """A mutation: no other name first."""
    state_files.write_bytes(path, content, sync=True)


def unsynced(path: Path, content: bytes) -> None:
    """A mutation: the name may be on the disk before the content."""
    temporary = path.with_name(path.name + ".part")
    state_files.write_bytes(temporary, content)
    os.replace(temporary, path)


@pytest.mark.parametrize("mutation", [in_place, unsynced])
def test_a_save_that_is_not_safe_is_seen(
    mutation: Callable[[Path, bytes], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The shim tells a snapshot written in place, and one without fsync, from ours."""
    monkeypatch.setattr(snapshot, "write_whole", mutation)
    disk = saved(made(tmp_path / "disk"), monkeypatch)
    torn, _ = torn_and_lost(disk, tmp_path / "left")
    assert torn > 0


def change(project: Path, text: str) -> tuple[Change, str]:
    before = project.read_text("utf-8")
    made_by = Change(
        0, "2026-01-01", ADD, "effect", "a", "test", "", {}, {}, None, before, ""
    )  # fmt: skip
    return made_by, before + text


def test_row_33_power_cuts_while_a_project_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figure: Figure
) -> None:
    """The project is that of before or behind each change; the history can be read and goes on."""
    folder = made(tmp_path / "disk")
    project = folder / "machine.toml"
    shutil.copy(machine().project.path, project)
    texts = [project.read_bytes()]
    with watched(folder, monkeypatch) as disk:
        disk.settle()
        for k in range(2):
            history.write(project, [change(project, f"\n# change {k}\n")])
            disk.acknowledged = k + 1
            texts.append(project.read_bytes())
    torn = lost = unreadable = 0
    for acknowledged, left in unlike(disk):
        there = laid_out(left, tmp_path / "left") / project.name
        content = there.read_bytes() if there.exists() else b""
        torn += content not in texts
        lost += content not in texts[acknowledged:]
        try:
            lost += len(history.read(there)) < acknowledged
            history.write(there, [change(there, "\n# again\n")])
            load(there)
        except RtidError:
            unreadable += 1
    print(f"{len(unlike(disk))} states of the disk")
    figure(33, "project files torn by a power cut at any call", torn, 0)
    figure(33, "changes of a project lost", lost, 0)
    figure(33, "histories that cannot be gone on with", unreadable, 0)
