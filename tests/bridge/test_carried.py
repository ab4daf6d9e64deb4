"""Kernels that came with the sources: taken over where they fit, told where they do not."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from firmware_bridge.carried import ABOUT, NAME

ROOT = Path(__file__).parents[2]
# a processor that has less than any that runs the tests
OLD = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": "+64bit,+cx8,+sse,+sse2"}
MODULE = """
from pathlib import Path
from typing import NamedTuple
from firmware_bridge.kernel_cache import cache_folder, cached

HERE = Path(__file__).parent
FOLDER = cache_folder("tiny", HERE, [HERE / "sum.py"])

def twice(x):
    return 2.0 * x

class Pair(NamedTuple):  # whoever reads the index of `total` imports it
    a: float
    b: float

def total(pair):
    return pair.a + pair.b

twice, total = cached(FOLDER, twice), cached(FOLDER, total)
"""
CALL = """
from tiny.sum import Pair, total, twice
assert twice(21.0) == 42.0 and total(Pair(3.0, 4.0)) == 7.0
print(*(sum(len(getattr(kernel.stats, name)) for kernel in (twice, total))
        for name in ("cache_hits", "cache_misses")))
"""
DESCRIBE = """
from firmware_bridge.carried import describe
from tiny.sum import FOLDER, HERE, Pair, total, twice
twice(21.0), total(Pair(3.0, 4.0))
describe(FOLDER, HERE)
"""
ALL = 2  # kernels
only_x86 = pytest.mark.skipif(os.uname().machine != "x86_64", reason="levels of x86-64")


def python(place: Path, code: str, **settings: str) -> subprocess.CompletedProcess[str]:
    """Run code on the package in `place`, with the cache that lies beside its sources."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA_", "PYTHON"))}
    paths = {"PYTHONPATH": f"{place}:{ROOT}"}
    return subprocess.run([sys.executable, "-c", code], env=kept | paths | settings,
                          capture_output=True, text=True, check=True)  # fmt: skip


def package(place: Path, text: str = MODULE) -> Path:
    folder = place / "tiny"
    folder.mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "sum.py").write_text(text)
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package whose kernel was compiled for an old processor, with the cache beside it."""
    place = tmp_path_factory.mktemp("made")
    folder = package(place)
    settings = OLD if os.uname().machine == "x86_64" else {}
    python(place, DESCRIBE, **settings)
    return folder


@pytest.fixture
def travelled(made: Path, tmp_path: Path) -> Callable[..., Path]:
    """The package in another place, with its kernels as a wheel carries them."""

    def travel(text: str = MODULE) -> Path:
        folder = package(tmp_path / "far" / "away", text)
        (kernels,) = (made / "__pycache__").glob("tiny-*")
        shutil.copytree(kernels, folder / NAME / kernels.name)
        return folder

    return travel


def hits(folder: Path, **settings: str) -> tuple[int, int, str]:
    """Kernels loaded, kernels compiled, and what was warned of."""
    done = python(folder.parent, CALL, **settings)
    loaded, compiled = done.stdout.split()
    return int(loaded), int(compiled), done.stderr


def change(folder: Path, **values: object) -> None:
    (about,) = folder.glob(f"{NAME}/*/{ABOUT}")
    about.write_text(json.dumps(json.loads(about.read_text()) | values))


def test_they_are_loaded_in_another_folder_and_on_a_newer_processor(
    travelled: Callable[..., Path],
) -> None:
    folder = travelled()
    assert hits(folder) == (ALL, 0, "")
    assert hits(folder) == (ALL, 0, "")


def test_a_cache_that_is_only_copied_misses(made: Path, tmp_path: Path) -> None:
    """What this is for; when numba mends it, this module can go."""
    folder = package(tmp_path)
    shutil.copytree(made / "__pycache__", folder / "__pycache__")
    assert hits(folder)[:2] == (0, ALL)


@only_x86
def test_an_older_processor_is_told_what_it_lacks(travelled: Callable[..., Path]) -> None:
    folder = travelled()
    change(folder, features=["avx2", "cx8"])
    loaded, compiled, told = hits(folder, **OLD)
    assert (loaded, compiled) == (0, ALL) and "this processor has no avx2" in told
    assert hits(folder, **OLD) == (ALL, 0, "")  # said once


@pytest.mark.parametrize(
    ("name", "value"), [("numba", "0.1"), ("python", "cpython-27"), ("triple", "vax-dec-ultrix")]
)
def test_another_version_is_told(travelled: Callable[..., Path], name: str, value: str) -> None:
    folder = travelled()
    change(folder, **{name: value})
    loaded, compiled, told = hits(folder)
    assert (loaded, compiled) == (0, ALL) and f"they were made for {name} {value}" in told


def test_changed_sources_are_told(travelled: Callable[..., Path]) -> None:
    loaded, compiled, told = hits(travelled(MODULE + "\n# another\n"))
    assert (loaded, compiled) == (0, ALL) and "the sources were changed since" in told


@pytest.mark.parametrize("damaged", [ABOUT, "*.nbi"])
def test_damaged_ones_are_told_and_made_anew(travelled: Callable[..., Path], damaged: str) -> None:
    folder = travelled()
    for path in (folder / NAME).rglob(damaged):
        path.write_bytes(b"\x80garbage")
    loaded, compiled, told = hits(folder)
    assert (loaded, compiled) == (0, ALL) and "it cannot be read" in told
