"""Fault 23: the cache of compiled kernels is damaged, or can be written nowhere."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.faults.conftest import Figure
from tests.faults.harness import machine
from tests.faults.process import a_group

pytestmark = pytest.mark.soak  # each of them compiles everything: minutes on a busy machine
COLD_S = 10.0


def start(folder: Path, environment: dict[str, str], **options: object) -> tuple[float, str]:
    """Run the daemon for a second; how long all of it took, s, and what it logged."""
    project = machine().trace.with_suffix(".toml")
    command = [
        sys.executable, "-m", "rtid", "run", str(project), "--bus", f"udp_multicast:{a_group()}",
        "--test-bus", "--for", "1", "--state", str(folder / "state"),
    ]  # fmt: skip
    begin_s = time.monotonic()
    found = subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, check=False,
        **options,  # type: ignore[call-overload]
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    return time.monotonic() - begin_s - 1.0, found.stderr


def test_row_23_damaged_cache(tmp_path: Path, figure: Figure) -> None:
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    cold_s, _ = start(tmp_path, cache)
    warm_s, _ = start(tmp_path, cache)
    figure(23, "start and stop, cache warm", warm_s, unit="s")
    figure(23, "start and stop, nothing compiled", cold_s, unit="s")  # 10 s are wanted: see below
    files = sorted((tmp_path / "cache").rglob("*.nb?"))
    chance, failed = random.Random(23), 0
    for kind in ("index cut", "index garbage", "code cut"):
        copy = tmp_path / kind.replace(" ", "-")
        shutil.copytree(tmp_path / "cache", copy)
        suffix = ".nbi" if "index" in kind else ".nbc"
        for file in (copy / f.relative_to(tmp_path / "cache") for f in files):
            if file.suffix == suffix:
                content = file.read_bytes()
                cut = content[: len(content) // 2]
                file.write_bytes(cut if "cut" in kind else chance.randbytes(len(content)))
        _, said = start(tmp_path, {"NUMBA_CACHE_DIR": str(copy)})
        failed += "compiling again" not in said
    figure(23, "damaged caches that nobody was warned of", failed, 0)


@pytest.mark.xfail(reason="37 s of processor time: the engine alone takes 20", strict=True)
def test_row_23_cold_start_within_10_s(tmp_path: Path, figure: Figure) -> None:
    cold_s, _ = start(tmp_path, {"NUMBA_CACHE_DIR": str(tmp_path / "cache")})
    figure(23, "cold start", cold_s, COLD_S, "s")


def test_row_23_unwritable_cache(tmp_path: Path, figure: Figure) -> None:
    """As a user who may write nowhere but into the state folder."""
    if os.geteuid() != 0:
        pytest.skip("only root can become nobody")
    shutil.copytree(machine().trace.parent, tmp_path / "machine")
    for path in (tmp_path, *tmp_path.rglob("*")):
        path.chmod(0o777 if path.is_dir() else 0o666)
    python = Path(sys.executable).resolve()
    closed = [p for p in (*tmp_path.parents, *python.parents) if p.stat().st_mode & 0o001 == 0]
    if closed:
        pytest.skip(f"nobody but its owner can enter {closed[0]}")
    seconds, _ = start(tmp_path, {"HOME": "/nonexistent"}, user=65534, group=65534)
    figure(23, "start and stop, cache not writable", seconds, unit="s")
