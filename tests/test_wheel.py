"""The wheel: it holds every file of both packages, and runs where there is no checkout.

The empty virtual environment, with dependencies from the registry, is in `tests/campaign`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

from tools.wheel import PACKAGES, ROOT, build, pip

IMPORT_ALL = """
import importlib, pkgutil, sys
for top in ("rtid", "firmware_bridge"):
    for found in pkgutil.walk_packages(importlib.import_module(top).__path__, top + "."):
        if not found.name.endswith("__main__"):
            print(importlib.import_module(found.name).__file__)
assert not {"tests", "tools", "benchmarks"} & set(sys.modules)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """A folder with the wheel and nothing else; the dependencies are those of the tests."""
    target = wheel.parent / "site"
    pip(wheel.parent, "install", "--no-compile", "--target", target, wheel)
    return target


def away(site: Path, *command: object) -> str:
    """Output of a command that finds the installed packages, run far from the checkout."""
    place = site.parent / "elsewhere"
    place.mkdir(exist_ok=True)
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=place,
        env=kept | {"PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def test_every_file_of_the_packages_is_in_the_wheel(wheel: Path) -> None:
    wanted = {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and not {"__pycache__"} & set(path.parts) and ".nb" not in path.suffix
    }
    packed = set(ZipFile(wheel).namelist())
    assert not wanted - packed
    assert {name.split("/")[0] for name in packed} - set(PACKAGES) == {dist_info(packed)}


def dist_info(packed: set[str]) -> str:
    (name,) = {n.split("/")[0] for n in packed if ".dist-info" in n}
    return name


def test_the_script_runs_from_the_installed_wheel(installed: Path) -> None:
    script = installed / "bin" / "rtid"
    assert away(installed, script, "--version").startswith("rtid ")
    assert "Learn the flow maps" in away(installed, script, "demo", "--help")


def test_every_module_can_be_imported_from_the_installed_wheel(installed: Path) -> None:
    modules = away(installed, "-c", IMPORT_ALL).split()
    assert len(modules) > 350
    assert all(Path(module).is_relative_to(installed) for module in modules)
