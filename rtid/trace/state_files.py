"""Files of the state folder: what lies there may be a FIFO, a folder, a device or a link.

To open a FIFO waits for its other end for ever, and to write through a link replaces what it points
at: both are refused at once, as OSError with the file's name.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import BinaryIO

FOR_WRITING = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux: fcntl.h, linux/fs.h
LOOKS, PAUSE_S = 50, 2e-3  # for a file that nobody writes over


def read_bytes(path: Path, follow: bool = True) -> bytes:
    """What a file holds; OSError where it is none.  follow: where a link leads to one as well."""
    with opened(path, os.O_RDONLY | (0 if follow else os.O_NOFOLLOW)) as file:
        return file.read()


def read_settled(path: Path) -> bytes:
    """The same of a file that is `overwritten` and exchanged, never half of it.

    What a reader has opened may be the older one by the time that it reads: the writer has it then,
    and another stands in its place.
    """
    for _ in range(LOOKS):
        with opened(path) as file:
            if _is_locked(file, fcntl.LOCK_SH):
                return file.read()
        time.sleep(PAUSE_S)
    return read_bytes(path)


def overwritten(path: Path) -> BinaryIO:
    """A file to write over that nobody reads; where somebody does, a new one.  OSError."""
    file = create(path)
    if not _is_locked(file, fcntl.LOCK_EX):
        file.close()
        path.unlink()
        file = create(path)
    return file


def _is_locked(file: BinaryIO, how: int) -> bool:
    """True once it is locked, until it is closed, or where the file system has no locks."""
    try:
        fcntl.flock(file, how | fcntl.LOCK_NB)
    except OSError as error:
        return not isinstance(error, BlockingIOError)
    return True


def write_bytes(path: Path, content: bytes, sync: bool = False) -> None:
    """Write a file anew.  sync: it is on the disk on return.  OSError."""
    with create(path) as file:
        file.truncate()
        file.write(content)
        file.flush()
        if sync:
            os.fsync(file.fileno())


def create(path: Path) -> BinaryIO:
    """A file to lock, or to write to, with what it held before.  OSError."""
    return opened(path, FOR_WRITING)


def opened(path: Path, flags: int = os.O_RDONLY) -> BinaryIO:
    """A plain file, never waited for.  OSError."""
    fd = os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    try:
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            raise OSError(errno.EINVAL, "not a plain file", str(path))
        return os.fdopen(fd, "rb" if flags & os.O_ACCMODE == os.O_RDONLY else "r+b")
    except BaseException:
        os.close(fd)
        raise


def made_folder(folder: Path) -> None:
    """Make a folder that is there after a power cut; OSError."""
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        _sync(folder.parent)


def _sync(folder: Path) -> None:
    """Have the names in a folder on the disk."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def write_whole(path: Path, content: bytes) -> None:
    """Replace a file by these bytes, so that after a power cut there is the old one or the new."""
    temporary = path.with_name(path.name + ".part")
    write_bytes(temporary, content, sync=True)
    rename(temporary, path)


@contextmanager
def locked(path: Path, refusal: Exception) -> Iterator[None]:
    """Hold a lock file; the refusal is raised where another process does.  OSError."""
    with create(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise refusal from None
        yield


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside a file to write to, which takes the file's place at the end, whole or not."""
    part = path.with_name(path.name + ".part")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def name_also(path: Path, name: Path) -> None:
    """Give a file that is only ever replaced a second name; OSError.

    A copy where the file system has no links.
    """
    temporary = name.with_name(name.name + ".part")
    temporary.unlink(missing_ok=True)
    try:
        os.link(path, temporary)
    except OSError:
        write_bytes(temporary, read_bytes(path), sync=True)
    rename(temporary, name)


def rename(path: Path, name: Path) -> None:
    """Give a file another name, which is on the disk on return; OSError."""
    os.replace(path, name)
    _sync(name.parent)


def exchange(new: Path, old: Path) -> None:
    """Give two files each other's name at one moment, so that both keep their room; OSError.

    Where there is no old one, or the system cannot do that, the new one replaces it.
    """
    rename = getattr(_libc(), "renameat2", None)
    names = AT_FDCWD, os.fsencode(new), AT_FDCWD, os.fsencode(old)
    if rename is None or rename(*names, RENAME_EXCHANGE) != 0:
        os.replace(new, old)


@cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None)
