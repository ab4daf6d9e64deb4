"""A disk that a power cut may hit between any two calls: what can be on it then.

Python's own calls run on a real folder.  At each `fsync`, `replace`, `unlink` and at each opening
the shim notes what the disk is sure to hold: contents of files since their last fsync, names since
the last fsync of their folder.  A power cut leaves either the names that were sure or those of now,
and of a file whose content is not sure nothing, one half of it, or all.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

Names = dict[str, int]  # path below the folder -> inode
Contents = dict[int, bytes]
TORN: dict[str, Callable[[bytes], bytes]] = {
    "nothing": lambda _: b"",
    "half": lambda content: content[: len(content) // 2],
    "all": lambda content: content,
}


@dataclass
class Disk:
    """A folder under watch; `cuts`: (what was acknowledged, what may lie there) at each call."""

    folder: Path
    acknowledged: int = 0
    cuts: list[tuple[int, dict[str, bytes]]] = field(default_factory=list)
    _names: Names = field(default_factory=dict)
    _sure: Contents = field(default_factory=dict)

    def settle(self) -> None:
        """All that lies there is on the disk."""
        self._names, self._sure = self._now()

    def cut(self) -> None:
        """The power may fail here."""
        names, contents = self._now()
        for known in (self._names, names):
            for torn in TORN.values():
                self.cuts.append((self.acknowledged, self._left(known, contents, torn)))

    def sync(self, fd: int) -> None:
        """A file's content, or a folder's names, are on the disk from here on."""
        names, contents = self._now()
        inode = os.fstat(fd).st_ino
        if inode in contents:
            self._sure[inode] = contents[inode]
        else:
            folder = Path(os.readlink(f"/proc/self/fd/{fd}"))
            inside = str(folder.relative_to(self.folder)) if folder != self.folder else "."
            mine = {n for n in {*names, *self._names} if str(Path(n).parent) == inside}
            for name in mine:
                self._names.pop(name, None)
                if name in names:
                    self._names[name] = names[name]

    def _left(
        self, names: Names, contents: Contents, torn: Callable[[bytes], bytes]
    ) -> dict[str, bytes]:
        left = {}
        for name, inode in names.items():
            sure = self._sure.get(inode)
            now = contents.get(inode, sure or b"")  # gone by now: as it was last sure
            kept = sure if sure is not None and now.startswith(sure) else b""  # appended to
            left[name] = now if sure == now else kept + torn(now[len(kept) :])
        return left

    def _now(self) -> tuple[Names, Contents]:
        files = [path for path in self.folder.rglob("*") if path.is_file()]
        names = {str(path.relative_to(self.folder)): path.stat().st_ino for path in files}
        contents = {path.stat().st_ino: path.read_bytes() for path in files}
        return names, contents


@contextmanager
def watched(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    """Note all calls that change what a power cut would leave."""
    disk = Disk(folder)
    real = {name: getattr(os, name) for name in ("fsync", "replace", "unlink", "open")}

    def shim(name: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            disk.cut()
            result = real[name](*arguments, **options)
            if name == "fsync":
                disk.sync(arguments[0])
            disk.cut()
            return result

        return call

    with monkeypatch.context() as patch:
        for name in real:
            patch.setattr(os, name, shim(name))
        yield disk
    disk.cut()


def laid_out(content: dict[str, bytes], folder: Path) -> Path:
    """What a power cut has left, in a folder of its own."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, data in content.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return folder
