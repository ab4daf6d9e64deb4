"""Where compiled kernels are kept, and how a cache that may only be read is used all the same.

numba's cache looks at the file of the function that is called, not at those of its callees: an old
binary would survive a change of them.  So the cache lies in a folder named by the digest of all
sources.  And numba wants to write where it reads: kernels that were compiled at installation into a
folder that is closed by now are taken from a copy.

Kernels that came with the sources are taken over, see `carried`.

Who starts while another process compiles the same kernel, as the daemon's helpers do, waits for it.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from numba import config, njit
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import is_jitted

from firmware_bridge.carried import adapt, take_over
from firmware_bridge.kept_kernels import KEPT, load_light
from firmware_bridge.kernel_parts import compiled_as
from firmware_bridge.lean_compiler import OPTIONS

# what the compiled code hangs on beside its sources
COMPILER = [Path(__file__).with_name(f"{name}.py") for name in ("kernel_parts", "lean_compiler")]
WAIT_S = 120.0  # for another process that compiles the same: it may have been stopped


def cache_folder(name: str, beside: Path, sources: Iterable[Path]) -> Path | None:
    """A folder `name-DIGEST` to keep kernels in, None where nothing can be written.

    The first of NUMBA_CACHE_DIR, __pycache__ beside the sources, the user's cache and the system's
    folder for temporary files that holds them or takes them.
    """
    name = f"{name}-{_digest([*sources, *COMPILER])}"
    for folder in (place / name for place in _places(beside)):
        if _is_writable(folder):
            take_over(folder, beside)
            return folder
        if next(folder.glob("**/*.nbi"), None) is not None:
            return _copied(folder)
    warnings.warn(
        "no folder for compiled kernels can be written: each start compiles for half a minute; "
        "set NUMBA_CACHE_DIR",
        stacklevel=2,
    )
    return None


def cached(folder: Path | None, function: Callable[..., Any], **options: Any) -> Any:
    """`njit` of a function, kept in the folder where there is one."""
    options = {"no_cfunc_wrapper": True} | OPTIONS | options  # nothing is called from C
    if folder is None:
        return njit(**options)(function)
    before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
    try:
        kernel = njit(cache=True, **options)(function)
    finally:
        config.CACHE_DIR = before
    if is_jitted(kernel):  # not where NUMBA_DISABLE_JIT is set
        load_light(kernel._cache)
        _compile_once(kernel, lock_of(folder, function))
    return kernel


def lock_of(folder: Path, function: Callable[..., Any]) -> Path:
    """The file that a process holds while it compiles the function or loads it."""
    return folder / f"{function.__module__}.{function.__qualname__}.lock"


def _compile_once(kernel: Any, lock: Path) -> None:
    """Let a kernel be compiled by one process at a time: who comes second loads it."""
    compiled, module = kernel.compile, kernel.__module__.rpartition(".")[2]

    def compile_alone(signature: Any) -> Any:
        if isinstance(signature, tuple) and signature in kernel.overloads:
            return compiled(signature)
        # numba's lock first, in every thread; a kernel that a part calls is still one for Python
        with global_compiler_lock, alone(lock), compiled_as(KEPT or JITCodeLibrary):
            adapt(Path(kernel.stats.cache_path), f"{module}.{kernel.__qualname__}")
            try:
                return compiled(signature)
            except OSError as error:  # it is compiled, but the disk is full: no daemon must end
                warnings.warn(f"a compiled kernel cannot be kept: {error}", stacklevel=2)
                return compiled(signature)

    kernel.compile = compile_alone


@contextlib.contextmanager
def alone(lock: Path) -> Iterator[None]:
    """Hold a file that no other process holds; without it after WAIT_S, or where none can be."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            file, end_s = stack.enter_context(lock.open("ab")), time.monotonic() + WAIT_S
            while not _held(file.fileno()) and time.monotonic() < end_s:
                time.sleep(0.05)
        yield


def _held(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _digest(sources: Iterable[Path]) -> str:
    total = hashlib.sha256()
    for source in sorted(sources):
        total.update(source.read_bytes())
    return total.hexdigest()[:12]


def _places(beside: Path) -> Iterator[Path]:
    if config.CACHE_DIR:
        yield Path(config.CACHE_DIR)
    yield beside / "__pycache__"
    yield Path.home() / ".cache" / "rtid"
    temporary = (
        Path(tempfile.gettempdir()) / f"rtid-{os.getuid()}"
    )  # survives this process: others start
    with contextlib.suppress(OSError):
        temporary.mkdir(mode=0o700, exist_ok=True)
        if temporary.stat().st_uid == os.getuid() and not temporary.is_symlink():
            yield temporary


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _copied(folder: Path) -> Path:
    copy = Path(tempfile.mkdtemp(prefix="rtid-kernels-"))
    atexit.register(shutil.rmtree, copy, ignore_errors=True)
    return Path(shutil.copytree(folder, copy / folder.name))
