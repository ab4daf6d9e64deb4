"""The wheel with its kernels compiled: a computer that has never seen rtid answers in seconds.

`make wheel` compiles what the usual path needs, for a level of processors (x86-64-v3: most since
2015) in place of the one at hand, and packs it into the wheel.  Then it installs the wheel in an
empty folder, starts the daemon and asks for a first answer there: an error where anything is
compiled again.
"""

from __future__ import annotations

import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from firmware_bridge.carried import NAME

ROOT = Path(__file__).parents[1]
PACKAGES = ("rtid", "firmware_bridge")
TEMPORARY = shutil.ignore_patterns("__pycache__", "*.egg-info", "*.nb?")
LOCKS = shutil.ignore_patterns("*.lock")
BESIDE = {"bridge": "firmware_bridge", "kernels": "rtid/kernels", "sim": "rtid/sim"}
# what the psABI of x86-64 calls level 3; of 64-bit ARM, what all of them have: not tried by us
LEVELS = {
    "x86_64": ("x86-64-v3", "64bit cmov cx8 cx16 fxsr mmx sahf popcnt sse sse2 sse3 ssse3 sse4.1 "
                            "sse4.2 avx avx2 bmi bmi2 f16c fma lzcnt movbe xsave crc32"),
    "aarch64": ("generic", "fp-armv8 neon"),
}  # fmt: skip
TRACE, PROJECT = "rtid-demo/machine.blf", "rtid-demo/machine.toml"
RUN = ("run", PROJECT, "--bus", "virtual:wheel", "--test-bus", "--state", "state", "--for")
REPLAY = ("replay", TRACE, "-p", PROJECT, "--no-cache")
USUAL = (
    ("demo",),
    (*RUN, "5"),
    ("check", TRACE, "-p", PROJECT),
    REPLAY,
    ("compare", TRACE, "-p", PROJECT),
    ("diagnose", "rtid-demo/worn.blf", "-p", "rtid-demo/worn.toml"),
    ("export", TRACE, "map.csv", "-p", PROJECT),
    ("quick", TRACE),
    ("report", TRACE, "-p", PROJECT),
)
DESCRIBE = """
import sys
from pathlib import Path
from firmware_bridge.carried import describe
describe(Path(sys.argv[1]), Path(sys.argv[2]))
"""


def main(out: Path) -> None:
    """Build, try, and tell what a first answer took."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        _compile(place)
        wheel = build(place, place / "cache")
        _try(place, wheel)
        out.mkdir(parents=True, exist_ok=True)
        kept = Path(shutil.copy(wheel, out))
    print(f"{kept}: {kept.stat().st_size / 1e6:.1f} MB")


def build(place: Path, kernels: Path | None = None) -> Path:
    """The wheel of the checkout in `place`, made from a copy, with the cache of kernels if any."""
    source = place / "source"
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=TEMPORARY)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for folder, beside in _kernels(kernels) if kernels else ():
        shutil.copytree(folder, source / beside / NAME / folder.name, ignore=LOCKS)
    pip(place, "wheel", "--no-build-isolation", "-w", place, source)
    (wheel,) = place.glob("*.whl")
    return wheel


def pip(place: Path, command: str, *options: object) -> None:
    """Call pip without a network."""
    alone = ("--disable-pip-version-check", "-q", command, "--no-deps", "--no-index")
    _python(place, {}, "-m", "pip", *alone, *options)


def _level() -> dict[str, str]:
    """Settings of numba for the level of this machine's family."""
    name, features = LEVELS[platform.machine()]
    listed = ",".join(f"+{feature}" for feature in features.split())
    return {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": listed}


def _compile(place: Path) -> None:
    """Do what users do, with an empty cache, and say beside it what it is made for."""
    settings = _level() | {"NUMBA_CACHE_DIR": str(place / "cache"), "PYTHONPATH": str(ROOT)}
    for words in USUAL:
        print("compiling: rtid", *words, flush=True)
        _python(place, settings, "-m", "rtid", *words)
    for folder, beside in _kernels(place / "cache"):
        _python(place, settings, "-c", DESCRIBE, folder, ROOT / beside)


def _kernels(cache: Path) -> Iterator[tuple[Path, str]]:
    """The folders of a cache, each with the folder of its sources."""
    for name, beside in BESIDE.items():
        (folder,) = cache.glob(f"{name}-*")
        yield folder, beside


def _try(place: Path, wheel: Path) -> None:
    """Start the installed wheel where nothing is compiled, and tell what that takes."""
    site = place / "site"
    pip(place, "install", "--no-compile", "--target", site, wheel)
    for name, words in (("the daemon, from start to stop", (*RUN, "0.1")), ("replay", REPLAY)):
        for beside in BESIDE.values():
            shutil.rmtree(site / beside / "__pycache__", ignore_errors=True)
        print(f"{name}: {_seconds(place, site, *words):.1f} s of processor time")


def _seconds(place: Path, site: Path, *words: str) -> float:
    """Processor time of a command of the packages in `site`; an error if it compiles a kernel."""
    settings = {"HOME": str(place), "PYTHONPATH": str(site), "NUMBA_DEBUG_CACHE": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    told = _python(place, settings, "-W", "error", "-m", "rtid", *words)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    compiled = [line for line in told.splitlines() if "data saved" in line]
    if compiled or "data loaded" not in told:
        raise SystemExit("\n".join([f"rtid {' '.join(words)} compiles again:", *compiled]))
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _python(place: Path, settings: dict[str, str], *words: object) -> str:
    """Output of this Python, run in a folder; what it prints of an error is shown."""
    command = [sys.executable, *map(str, words)]
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA_", "PYTHON"))}
    done = subprocess.run(command, cwd=place, env=kept | settings, text=True,
                          stdout=subprocess.PIPE, check=True)  # fmt: skip
    return done.stdout


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out"))
