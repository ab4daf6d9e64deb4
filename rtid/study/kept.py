"""What was learned from a trace is kept beside it: commands after one another learn once.

    TRACE's folder/.rtid/KEY-KIND.kept,   KEY = digest of trace, project and program

in the user's cache folder where the trace's folder takes no file.  Everything in it can be made
again: it is safe to delete, what is damaged or foreign is not looked at, and the oldest goes when
a folder holds more than MOST_BYTES.  Only commands keep anything: `keeping`.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, fields
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import rtid
from rtid.errors import RtidError
from rtid.project import Project
from rtid.study.packed import packed, unpacked
from rtid.trace.state_files import read_bytes

FOLDER, SUFFIX = ".rtid", ".kept"
MOST_BYTES = 64_000_000
PLACE = "RTID_CACHE"  # environment: a folder for all that is kept, or OFF
OFF = "off"
PLUGINS = ("rtid.effects", "rtid.formats")  # entry points that a fit depends on; not imported here
ASIDE = ("prior", "publish", "daemon", "excite")  # sections that no fit depends on
_IS_ON = ContextVar("is_on", default=False)


@contextmanager
def keeping(wanted: bool = True) -> Iterator[None]:
    """Keep, and look up, what is learned inside."""
    token = _IS_ON.set(wanted and os.environ.get(PLACE) != OFF)
    try:
        yield
    finally:
        _IS_ON.reset(token)


@dataclass(frozen=True)
class Kept:
    """What is kept of one trace, or of several in one fit, under one project.

    Every failure to read or write is silent.
    """

    key: str
    folders: tuple[Path, ...]  # the first that takes a file is written to

    @classmethod
    def of(cls, project: Project, traces: tuple[Path, ...]) -> Kept | None:
        """None where nothing is to be kept, or where the user's own module may change unseen."""
        if not _IS_ON.get() or project.sections.project.effects_module:
            return None
        place = os.environ.get(PLACE)
        folders = (Path(place),) if place else (traces[0].resolve().parent / FOLDER, user_folder())
        files = "".join(_of_file(trace) for trace in traces)
        key = files if len(traces) == 1 else _hash(files.encode()).hexdigest()
        return cls(f"{key}-{_of_project(project)}", folders)

    def read(self, kind: str, classes: tuple[type, ...]) -> Any:
        """What was kept of this kind; None where there is nothing of use."""
        for folder in self.folders:
            path = folder / f"{self.key}-{kind}{SUFFIX}"
            with suppress(OSError, RtidError):
                made = unpacked(read_bytes(path), _secret(), classes)
                os.utime(path)
                return made
        return None

    def write(self, kind: str, value: Any) -> None:
        """Keep a value of this kind, in the first folder that takes it."""
        for folder in self.folders:
            with suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                _put(folder / f"{self.key}-{kind}{SUFFIX}", packed(value, _secret()))
                _evict(folder)
                return


def user_folder() -> Path:
    """Where the user's programs keep what can be made again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rtid"


def _put(path: Path, content: bytes) -> None:
    """The file whole or not at all; two commands may write the same."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _evict(folder: Path) -> None:
    """Delete the oldest files until what is kept here is no more than MOST_BYTES."""
    files = sorted(folder.glob(f"*{SUFFIX}"), key=lambda path: path.stat().st_mtime_ns)
    total = sum(path.stat().st_size for path in files)
    for path in files[:-1]:
        if total <= MOST_BYTES:
            return
        total -= path.stat().st_size
        path.unlink(missing_ok=True)


@cache
def _secret() -> bytes:
    """Of this user: what another one has sealed is not read.  OSError where it cannot be kept."""
    path = user_folder() / "secret"
    with suppress(OSError):
        known = read_bytes(path)
        if len(known) == hashlib.blake2b.MAX_KEY_SIZE:
            return known
    path.parent.mkdir(parents=True, exist_ok=True)
    made = secrets.token_bytes(hashlib.blake2b.MAX_KEY_SIZE)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        file.write(made)
    os.replace(part, path)
    return made


def _of_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, _hash).hexdigest()


def _of_project(project: Project) -> str:
    """What the fit depends on: declaration, spans, added effects, bit layouts, the program."""
    sections = project.sections
    words = {f.name: getattr(sections, f.name) for f in fields(sections) if f.name not in ASIDE}
    layouts = [(_of_file(place.file), place.node) for place in project.databases]
    text = f"{project.digest} {sorted(words.items())!r} {layouts} {_of_program()} {_of_plugins()}"
    return _hash(text.encode()).hexdigest()


@cache
def _of_program() -> str:
    """Of the program's files, by size and date."""
    root = Path(rtid.__file__).parent
    words = [line for f in (root, root.with_name("firmware_bridge")) for line in _dates_in(f)]
    return _hash("\n".join(words).encode()).hexdigest()


def _of_plugins() -> list[str]:
    """Of the packages that bring effects or log formats, which nobody loads for it."""
    brought = [p for group in PLUGINS for p in entry_points(group=group)]
    words = [f"{plugin.name} = {plugin.value}" for plugin in brought]
    for name in sorted({plugin.module.partition(".")[0] for plugin in brought}):
        spec = find_spec(name)
        folders = spec.submodule_search_locations if spec else None
        for place in folders or ([spec.origin] if spec and spec.origin else ()):
            words += _dates_in(Path(place))
    return words


def _dates_in(place: Path) -> list[str]:
    """The code and pages of a folder, or one file, by size and date."""
    paths = sorted(place.rglob("*")) if place.is_dir() else [place]
    known = [(path, path.stat()) for path in paths if path.suffix in (".py", ".toml")]
    return [f"{path.relative_to(place)} {s.st_size} {s.st_mtime_ns}" for path, s in known]


def _hash(content: bytes = b"") -> Any:
    return hashlib.blake2b(content, digest_size=12)
