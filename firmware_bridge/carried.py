"""Compiled kernels that travel: in a wheel, to a computer that has never compiled one.

numba names a folder of its cache by where the sources lie, and an entry by the exact processor that
compiled it: a cache that is copied misses in silence.  A folder of carried kernels says beside them
what they were made for, `carried.json`.  Whoever has the same numba and Python and a processor
that knows all their instructions takes them over under its own names; whoever has not is told why,
once, and compiles.

It leans on how numba keeps an index: its version, then (stamp of the source, {key: file}), where a
key is (signature, (triple, processor, features), digests of the function).  `make wheel` starts
what it has made in another folder and fails where anything is compiled there.
"""

from __future__ import annotations

import json
import os
import pickle
import sys
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import UserProvidedCacheLocator
from numba.core.registry import cpu_target

NAME = "carried"  # the folder beside the sources
ABOUT = "carried.json"
WAITING = ".carried"  # behind the name of an index
TAKEN = "carried.taken"  # in the folder of kernels: they were looked at; why they do not fit
UNREADABLE = (OSError, ValueError, TypeError, KeyError, AttributeError, EOFError,
              pickle.UnpicklingError, ImportError)  # fmt: skip


@dataclass(frozen=True)
class Made:
    """What kernels were made for, and which folder of the cache belongs to which sources."""

    numba: str
    python: str  # e.g. cpython-311
    triple: str
    processor: str
    features: list[str]  # instruction sets that they use
    folders: dict[str, str]  # the cache's folder: the folder of the sources, from `beside`

    @classmethod
    def here(cls, folders: dict[str, str]) -> Made:
        """What this process compiles for."""
        triple, processor, features = _target()
        used = [name[1:] for name in features.split(",") if name.startswith("+")]
        python = str(sys.implementation.cache_tag)
        return cls(numba.__version__, python, triple, processor, used, folders)

    def objection(self) -> str | None:
        """Why this process cannot run them; None if it can."""
        here = Made.here({})
        for name in ("numba", "python", "triple"):
            wanted, found = getattr(self, name), getattr(here, name)
            if wanted != found:
                return f"they were made for {name} {wanted}, and this is {found}"
        missing = sorted(set(self.features) - set(here.features))
        return f"this processor has no {', '.join(missing)}" if missing else None


def describe(folder: Path, beside: Path) -> None:
    """Write `carried.json` into a folder of kernels, compiled by such a process as this one."""
    packages = {path.parent for path in _root(beside).rglob("*.py")}
    sources = {_cache_name(package): os.path.relpath(package, beside) for package in packages}
    found = {path.name: sources[path.name] for path in folder.iterdir() if path.is_dir()}
    (folder / ABOUT).write_text(json.dumps(asdict(Made.here(found)), indent=1) + "\n")


def take_over(folder: Path, beside: Path) -> None:
    """Copy into a folder of kernels those that came with the sources, if they fit; once.

    A kernel's index is made this process's own when the kernel is wanted, see `adapt`: it may name
    functions of modules that are being imported.
    """
    carried = beside / NAME
    if not carried.is_dir() or (folder / TAKEN).exists():
        return
    try:
        why = _taken(carried / folder.name, folder, beside)
    except UNREADABLE as error:
        why = _unreadable(error)
    (folder / TAKEN).write_text(why or "")
    if why:
        _warn(f"the compiled kernels that came with {beside.name} are not used: {why}")


def adapt(folder: Path, kernel: str) -> None:
    """Give the index of a kernel that was taken over the keys that this process asks for."""
    for index in folder.glob(f"{kernel}-*{WAITING}"):
        try:
            _put(index.with_suffix(""), b"".join(_for_this_processor(index)))
        except UNREADABLE as error:
            _warn(f"the compiled {kernel} is not used: {_unreadable(error)}")
        index.unlink()


def _taken(carried: Path, folder: Path, beside: Path) -> str | None:
    """Take the kernels over; what speaks against it."""
    if not carried.is_dir():
        return "the sources were changed since"
    made = Made(**json.loads((carried / ABOUT).read_text()))
    why = made.objection()
    for name, sources in {} if why else made.folders.items():
        _copy(carried / name, folder / _cache_name((beside / sources).resolve()))
    return why


def _copy(carried: Path, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for binary in carried.glob("*.nbc"):
        _put(folder / binary.name, binary.read_bytes())
    for index in carried.glob("*.nbi"):  # behind what they name
        _put(folder / f"{index.name}{WAITING}", index.read_bytes())


def _put(path: Path, content: bytes) -> None:
    """Write a file at once: another process may be reading there."""
    partial = path.with_name(f"{path.name}.{os.getpid()}")
    partial.write_bytes(content)
    partial.replace(path)


def _for_this_processor(index: Path) -> Iterator[bytes]:
    with index.open("rb") as file:
        version, (stamp, entries) = pickle.load(file), pickle.load(file)
    yield pickle.dumps(version)
    renamed = {(key[0], _target(), *key[2:]): name for key, name in entries.items()}
    yield pickle.dumps((stamp, renamed))


def _unreadable(error: Exception) -> str:
    return f"it cannot be read ({error!r})"


def _warn(text: str) -> None:
    warnings.warn(f"{text}; compiling, once, about a minute in all", stacklevel=4)


def _target() -> tuple[Any, ...]:
    """Triple, processor and features that this process compiles for, as numba's keys hold them."""
    target: tuple[Any, ...] = cpu_target.target_context.codegen().magic_tuple()
    return target


def _cache_name(package: Path) -> str:
    """How numba names its folder for the sources of a package."""
    return str(UserProvidedCacheLocator.get_suitable_cache_subpath(str(package / "any.py")))


def _root(beside: Path) -> Path:
    """The top package that a folder of sources lies in."""
    while (beside.parent / "__init__.py").exists():
        beside = beside.parent
    return beside
