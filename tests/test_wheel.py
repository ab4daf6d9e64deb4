"""The wheel: it holds every file of both packages, and runs where there is no checkout.

The empty virtual environment, with dependencies from the registry, is in `tests/campaign`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("rtid", "firmware_bridge")
TEMPORARY = shutil.ignore_patterns("__pycache__", "*.egg-info", "*.nb?")

IMPORT_ALL = """
import importlib, pkgutil, sys
for top in ("rtid", "firmware_bridge"):
    for found in pkgutil.walk_packages(importlib.import_module(top).__path__, top + "."):
        if not found.name.endswith("__main__"):
            print(importlib.import_module(found.name).__file__)
assert not {"tests", "tools", "benchmarks"} & set(sys.modules)
"""


def build(folder: Path) -> Path:
    """The wheel of the checkout, made from a copy, without a network."""
    source = folder / "source"
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=TEMPORARY)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip("wheel", "--no-build-isolation", "--no-deps", "--no-index", "-w", folder, source)
    (wheel,) = folder.glob("*.whl")
    return wheel


def pip(*arguments: object) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([*command, *map(str, arguments)], check=True)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """A folder with the wheel and nothing else; the dependencies are those of the tests."""
    target = wheel.parent / "site"
    pip("install", "--no-deps", "--no-index", "--no-compile", "--target", target, wheel)
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
