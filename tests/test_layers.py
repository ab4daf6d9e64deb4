"""The house stands as planned: imports point only downward, inner rooms know no bus, file or clock.

The order is that of the one data path: frame -> Trace -> Fit -> Map -> Comparison -> Diagnosis ->
Revision -> what is told of it.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = (  # from the ground up; what stands on one floor may not import its neighbours
    ("plain", "errors", "units"),
    ("model",),
    ("kernels",),
    ("estimator",),
    ("effects",),
    ("compare", "plants"),
    ("diagnose",),
    ("project",),
    ("trace",),
    ("maps",),
    ("study",),
    ("excite", "mcu"),
    ("fleet",),
    ("apply",),
    ("tell",),
    ("daemon",),
    ("ui",),
    ("cli",),
    ("__main__",),
)
FLOOR = {unit: floor for floor, units in enumerate(FLOORS) for unit in units}
LOOSE = {"__init__", "__main__", "errors", "model", "plain", "units"}
INNER = {u for floor in FLOORS[: FLOOR["project"]] for u in floor}
NEEDS_NO_OUTSIDE = {"can", "cantools", "serial", "time", "filterpy", "pyarrow", "typer", "rich"}
MAY_SIMULATE = ("rtid.study.demo", "rtid.cli.demo", "rtid.cli.simulate", "rtid.sim")
MOST_ARROWS = 191  # between the units of rtid/: half of what they were before they had floors
MODULES = sorted(p for top in ("rtid", "firmware_bridge") for p in (ROOT / top).rglob("*.py"))


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def imports(path: Path) -> list[str]:
    found = list[str]()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import hides the layer"
            found += (f"{node.module}.{alias.name}" for alias in node.names)
    return found


def unit_of(name: str) -> str:
    """The part of rtid/ that a dotted name lies in; "" for rtid itself."""
    second = name.split(".")[1:2]
    return second[0] if second and second[0] in {*FLOOR, "sim"} else ""


def arrows(path: Path) -> Iterator[tuple[str, str]]:
    """Units that a module of rtid/ imports from, each as (its own unit, the other)."""
    own = unit_of(module_name(path))
    for name in imports(path):
        other = unit_of(name) if name.startswith("rtid.") else ""
        if other and other != own:
            yield own, other


def test_only_six_modules_lie_loose() -> None:
    assert {path.stem for path in (ROOT / "rtid").glob("*.py")} == LOOSE


def test_every_unit_has_its_floor() -> None:
    folders = {p.name for p in (ROOT / "rtid").iterdir() if (p / "__init__.py").exists()}
    assert folders - {"sim"} == set(FLOOR) - LOOSE


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_imports_point_downward(path: Path) -> None:
    own = module_name(path)
    if own.startswith("firmware_bridge"):
        known = {name for name in imports(path) if name.split(".")[0] == "rtid"}
        assert not known, f"{own} knows nothing of rtid, yet imports {known}"
        return
    for unit, other in arrows(path):
        if other == "sim":
            assert own.startswith(MAY_SIMULATE), f"{own} imports the neighbour rtid.sim"
        elif unit not in {"", "sim"}:
            assert FLOOR[other] < FLOOR[unit], f"{own} imports upward: rtid.{other}"


def test_few_arrows_between_the_units() -> None:
    house = [path for path in MODULES if path.is_relative_to(ROOT / "rtid")]
    assert len({arrow for path in house for arrow in arrows(path)}) <= MOST_ARROWS


@pytest.mark.parametrize(
    "path", [p for p in MODULES if unit_of(module_name(p)) in INNER], ids=module_name
)
def test_inner_rooms_know_no_bus_no_file_no_clock(path: Path) -> None:
    assert not {name.split(".")[0] for name in imports(path)} & NEEDS_NO_OUTSIDE


def test_importing_the_estimator_pulls_in_no_bus() -> None:
    code = (
        "import sys, rtid.kernels, rtid.estimator\n"
        "print({'can', 'serial', 'filterpy'} & set(sys.modules) or '')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == ""
