"""What a firmware engineer asks of the C before it goes into a controller."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

import rtid
from rtid.mcu.c_tables import SOURCES
from rtid.mcu.write import write_sources
from tests.mcu import misra
from tests.mcu.compiled import COMPILER, STRICT
from tests.mcu.machine import small_valve

MOST_RECORDED = 40
MATH = {"sqrt", "exp", "fabs", "frexp", "ldexp", "fmin", "fmax", "rint", "fma"}
# what gcc asks of any environment, freestanding ones too
MEMORY = {"memcpy", "memset", "memmove"}


def test_misra() -> None:
    """No mandatory rule is broken, a required one only where the code says why: seven seconds."""
    if shutil.which("cppcheck") is None:
        pytest.skip("no cppcheck on this machine: MISRA C is not checked")
    found = misra.check()
    assert not [f for f in found if f.rule in misra.MANDATORY]
    assert not [f for f in found if f.required and not f.reason]
    assert len({(f.file, f.line) for f in found if f.required}) <= MOST_RECORDED
    if f"cppcheck {misra.version()} reads" not in misra.PAGE.read_text("utf-8"):
        return  # the table, and the reasons that are needed, are those of one version
    told = misra.PAGE.read_text("utf-8").split("<!-- misra:begin -->\n")[1].split("\n<!--")[0]
    assert told.split("\n") == list(misra.rows(found)), "renew it: python -m tests.mcu.misra"
    at = {(f.file, f.rule, f.line - above) for f in found for above in range(misra.ABOVE + 1)}
    for path in SOURCES.glob("*.[ch]"):
        for k, line in enumerate(path.read_text().splitlines(), 1):
            for rule in re.findall(r"MISRA ([\d.]+):", line):
                assert (path.name, rule, k) in at, "a reason for nothing"


@pytest.mark.parametrize("number", ["", "-DRTID_ESTIMATOR_FLOAT32"])
def test_nothing_but_math_and_memory_is_called(tmp_path: Path, number: str) -> None:
    """No heap, no stdio, no errno: the symbols that the compiled sources leave open."""
    if COMPILER is None:
        pytest.skip("no cc, gcc or clang on this machine: the C is not compiled")
    write_sources(tmp_path, small_valve())
    flags = [*STRICT, "-O2", "-fno-stack-protector", f"-I{tmp_path}", *filter(None, [number])]
    sources = sorted(map(str, SOURCES.glob("*.c")))
    subprocess.run([COMPILER, *flags, "-c", *sources], check=True, cwd=tmp_path)
    told = subprocess.run(
        ["nm", *(path.name for path in tmp_path.glob("*.o"))],
        check=True, capture_output=True, text=True, cwd=tmp_path,
    ).stdout  # fmt: skip
    undefined = set(re.findall(r" U (\w+)", told))
    defined = set(re.findall(r" [TR] (\w+)", told))
    assert {name for name in defined if not name.startswith("rtid_")} == set()
    allowed = MATH | {f"{name}f" for name in MATH} | MEMORY
    assert undefined - defined - allowed == set()
    assert re.search(r" [BbDdC] \w", told) is None  # nothing of its own in RAM


def test_look_up_and_download_compute_in_floats() -> None:
    """On a processor without double precision nothing else is fast."""
    for path in SOURCES.glob("rtid_[md]*.[ch]"):
        assert "double" not in path.read_text(), path.name


def test_each_part_tells_its_release(tmp_path: Path) -> None:
    """A version symbol in each source with functions for users; a line for a bill of materials."""
    assert f'"{rtid.__version__}"' in (SOURCES / "rtid_version.h").read_text()
    for name in ("estimator", "map", "map_fixed", "frames", "download"):
        code = (SOURCES / f"rtid_{name}.c").read_text()
        assert re.search(rf'rtid_{name}_version\[\] = "rtid_{name} " RTID_C_VERSION', code)
    write_sources(tmp_path, small_valve(), title=" of project 0123")
    tables = (tmp_path / "rtid_estimator_tables.h").read_text()
    assert re.search(
        rf"pkg:generic/rtid-c@{rtid.__version__}\?checksum=sha256:[0-9a-f]{{64}}", tables
    )
    assert '"chamber A of project 0123"' in tables
