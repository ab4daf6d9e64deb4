"""PROJECT.history.jsonl: every change of a project's model, one line each, never rewritten.

A line holds the project file as it was before the change, so that undo restores it byte for byte,
and a digest of the file after it, which shows whether somebody has edited the file since.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rtid.errors import RtidError, door

SUFFIX = ".history.jsonl"
ADD, DROP, UNDO = "add", "drop", "undo"


@dataclass(frozen=True)
class Change:
    """One line: what was done to which effect, when and why.

    section: the effect as it stands (add) or stood (drop) in the file; errors: as of its section,
    of this change; undoes: number of the change that an undo takes back; before: text of the file;
    after_sha256: of the file behind the change.
    """

    number: int
    date: str
    change: str
    effect: str
    where: str
    reason: str
    trace: str
    section: dict[str, Any]
    errors: dict[str, Any]
    undoes: int | None
    before: str
    after_sha256: str


def path_of(project: Path) -> Path:
    """Where the history of a project file lies."""
    return project.resolve().with_suffix(SUFFIX)


def read(project: Path) -> list[Change]:
    """All changes, oldest first; none where there is no history."""
    path = path_of(project)
    if not path.exists():
        return []
    changes = []
    lines = path.read_text("utf-8").splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):  # a power cut: its change was not carried out
        lines.pop()
    for k, line in enumerate(lines):
        try:
            changes.append(Change(**json.loads(line)))
        except (ValueError, TypeError) as error:
            remedy = "take this line out; the project file itself is not affected"
            raise RtidError(f"{path}: line {k + 1} is no change: {error}", remedy) from None
    return changes


@door
def history(project: str | Path) -> list[Change]:
    """All changes of a project that is there, oldest first.  RtidError where it is not."""
    project = Path(project)
    if not project.is_file():
        raise RtidError(f"{project}: no such file", "name a project file", 2)
    return read(project)


def state_beside(project: Path) -> Path:
    """The daemon's state folder, by the file alone: the project need not be loaded for it."""
    try:
        daemon = tomllib.loads(project.read_text("utf-8")).get("daemon", {})
    except (OSError, ValueError):  # the changes are told also of a file that cannot be read
        daemon = {}
    named = daemon.get("folder") if isinstance(daemon, dict) else None
    return project.parent / (named if isinstance(named, str) else f"{project.stem}.state")


def standing(changes: Sequence[Change]) -> list[Change]:
    """The changes that are not undone, oldest first."""
    undone = {change.undoes for change in changes}
    return [c for c in changes if c.change != UNDO and c.number not in undone]


def text_of(project: Path) -> str:
    """The project file, line ends as they are; refused where it could not be written again."""
    refuse_read_only(project)
    return project.read_bytes().decode("utf-8")


def refuse_read_only(project: Path) -> None:
    """A file without write permission is the user's wish, whatever the folder or root allows."""
    for path in (project, path_of(project)):
        if path.exists() and not path.stat().st_mode & 0o222:
            raise RtidError(f"{path} is read-only", f"chmod u+w {path}, or use --dry-run")


def write(project: Path, steps: Sequence[tuple[Change, str]]) -> list[Change]:
    """Carry out changes, each with the text of the file behind it; the numbered lines.

    The file appears whole or not at all, and only if it is a project; the history keeps its old
    length if anything fails.
    """
    project = project.resolve()
    refuse_read_only(project)
    number = max((c.number for c in read(project)), default=0)
    lines = [
        replace(change, number=number + k, after_sha256=digest(text))
        for k, (change, text) in enumerate(steps, 1)
    ]
    if project.read_bytes() != steps[0][0].before.encode():
        raise RtidError(f"{project} has changed meanwhile", "run the command again")
    from rtid.project.loading import load  # noqa: PLC0415 - who only reads need not wait for it

    temporary, history = project.with_name(project.name + ".part"), path_of(project)
    length = history.stat().st_size if history.exists() else None
    try:
        _put(temporary, steps[-1][1].encode())
        shutil.copymode(project, temporary)
        load(temporary)
        _append(history, lines)
        os.replace(temporary, project)
        _sync(project.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        _shorten(history, length)
        raise
    return lines


def digest(text: str) -> str:
    """Of a file's text."""
    return hashlib.sha256(text.encode()).hexdigest()


def _put(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _append(path: Path, lines: Sequence[Change]) -> None:
    """Behind the last whole line; what a power cut has left of another one goes."""
    whole = path.read_bytes().rpartition(b"\n") if path.exists() else (b"", b"", b"")
    with path.open("ab") as file:
        file.truncate(len(whole[0] + whole[1]))
        for line in lines:
            file.write(json.dumps(asdict(line)).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())
    _sync(path.parent)


def _sync(folder: Path) -> None:
    """Have the names in a folder on the disk."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _shorten(path: Path, length: int | None) -> None:
    """The history as long as it was."""
    if length is None:
        path.unlink(missing_ok=True)
    elif path.exists() and path.stat().st_size > length:
        os.truncate(path, length)
