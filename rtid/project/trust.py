"""Python that a project brings along: where it may lie, and whether the user has trusted it.

Loading a project never runs code of its author.  `rtid trust FILE` writes the SHA-256 of the file
into the user's own folder of settings; a file that has changed since is another file.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path, PurePosixPath

from rtid.errors import RtidError

STORE = Path("rtid", "trusted")
MOST_BYTES = 4 << 20


class NotTrustedError(RtidError):
    """A command needs effects in Python that nobody has trusted on this machine."""

    exit_code = 2

    def __init__(self, project: Path, python: Path) -> None:
        super().__init__(
            f"{project}: {python.name} is Python code that is not trusted here, and is not run",
            f"read it, then trust it as it is: rtid trust {python}",
        )


def located(folder: Path, name: str) -> tuple[Path, tuple[str, str] | None]:
    """Where `effects_module` lies, and what is wrong with that: problem and remedy."""
    path = folder / name
    if PurePosixPath(name).is_absolute() or not path.resolve().is_relative_to(folder.resolve()):
        remedy = "name a Python file in the folder of the project, or below"
        return path, (f"{name} lies outside the project's folder", remedy)
    if not path.is_file():
        return path, (f"{path} is no file", "name a Python file beside this one")
    if path.suffix != ".py":
        return path, (f"{path} is not Python", "name a file that ends in .py")
    if path.stat().st_size > MOST_BYTES:
        return path, (f"{path} is larger than {MOST_BYTES >> 20} MiB", "is it Python?")
    return path, None


def is_trusted(content: bytes) -> bool:
    """Whether the user has trusted a file with exactly this content."""
    return _digest(content) in _lines()


def trust(python: Path) -> None:
    """Trust this file as it is now."""
    line = f"{_digest(python.read_bytes())}  {python.resolve()}"
    _write(_lines() | {_digest(python.read_bytes()): line})


def forget(python: Path) -> bool:
    """Trust this file no more, nor what stood there before; False where it was not trusted."""
    lines, digest = _lines(), _digest(python.read_bytes())
    kept = {
        d: t
        for d, t in lines.items()
        if d != digest and t.split("  ", 1)[-1] != str(python.resolve())
    }
    if kept != lines:
        _write(kept)
    return kept != lines


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _store() -> Path:
    """A relative XDG_CONFIG_HOME counts for nothing: a project's folder could be meant."""
    given = os.environ.get("XDG_CONFIG_HOME", "")
    return (Path(given) if Path(given).is_absolute() else Path.home() / ".config") / STORE


def _lines() -> dict[str, str]:
    """What is trusted: the line of each digest; nothing where no store can be read."""
    try:
        texts = _store().read_text("utf-8").splitlines()
    except (OSError, RuntimeError, UnicodeDecodeError):  # RuntimeError: a user without a home
        return {}
    return {text.split("  ", 1)[0]: text for text in texts if text}


def _write(lines: dict[str, str]) -> None:
    store = _store()
    store.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    partial = store.with_name("part-trusted")
    with open(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
        file.write("".join(f"{text}\n" for text in lines.values()))
        file.flush()
        os.fsync(file.fileno())
    partial.replace(store)
