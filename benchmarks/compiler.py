"""Compile the hand-written C of benchmarks/c for this machine and load it through ctypes."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path
from tempfile import mkdtemp

import pytest

SOURCES = Path(__file__).parent / "c"
FLAGS = ("-O3", "-march=native", "-std=c11", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC")


def compile_c(name: str, generated: str = "") -> ctypes.CDLL:
    """Library from c/<name>.c, which may include `generated` as layout.h; skips without gcc."""
    gcc = shutil.which("gcc")
    if gcc is None:
        pytest.skip("no gcc on this machine: the hand-written C is not measured")
    folder = Path(mkdtemp(prefix="rtid-bench-"))
    (folder / "layout.h").write_text(generated)
    library = folder / f"{name}.so"
    command = [gcc, *FLAGS, f"-I{folder}", "-o", str(library), str(SOURCES / f"{name}.c"), "-lm"]
    subprocess.run(command, check=True)
    loaded = ctypes.CDLL(str(library))
    shutil.rmtree(folder)
    return loaded


def pointer(array: object) -> ctypes.c_void_p:
    """Address of a numpy array's data."""
    return ctypes.c_void_p(array.ctypes.data)  # type: ignore[attr-defined]
