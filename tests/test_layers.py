"""The layers import only downward, and the inner ones know no bus, no file and no clock."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
KERNELS, ESTIMATOR, SHELL, COMMAND = range(4)
LAYER = {
    "rtid": KERNELS,
    "rtid.errors": KERNELS,
    "rtid.kernels": KERNELS,
    "rtid.model": ESTIMATOR,
    "rtid.estimator": ESTIMATOR,
    "rtid.compare": ESTIMATOR,
    "rtid.diagnose": ESTIMATOR,
    "rtid.effects": ESTIMATOR,
    "rtid.excite": ESTIMATOR,
    "rtid.output_error": ESTIMATOR,
    "rtid.units": ESTIMATOR,
    "rtid.cli": COMMAND,
    "rtid.__main__": COMMAND,
}  # every other part of rtid is a shell: files, clocks and threads are allowed
NEEDS_NO_OUTSIDE = {"can", "cantools", "serial", "time", "filterpy", "pyarrow", "typer", "rich"}
MAY_SIMULATE = ("rtid.demo", "rtid.cli.demo", "rtid.cli.simulate", "rtid.paper", "rtid.sim")
MODULES = sorted(p for top in ("rtid", "firmware_bridge") for p in (ROOT / top).rglob("*.py"))


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import hides the layer"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def layer(name: str) -> int:
    return LAYER.get(".".join(name.split(".")[:2]), SHELL)


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_imports_point_downward(path: Path) -> None:
    own = module_name(path)
    for name in imports(path):
        if own.startswith("firmware_bridge"):
            assert name.split(".")[0] != "rtid", f"{own} knows nothing of rtid, yet imports {name}"
        elif name.startswith("rtid."):
            is_version = name == "rtid.__version__"
            assert is_version or layer(name) <= layer(own), f"{own} imports upward: {name}"
        if name.startswith("rtid.sim"):
            assert own.startswith(MAY_SIMULATE), f"{own} imports the neighbour {name}"


INNER = [p for p in MODULES if layer(module_name(p)) <= ESTIMATOR]


@pytest.mark.parametrize("path", INNER, ids=module_name)
def test_inner_layers_know_no_bus_no_file_no_clock(path: Path) -> None:
    outside = {name.split(".")[0] for name in imports(path)} & NEEDS_NO_OUTSIDE
    assert not outside


def test_importing_the_estimator_pulls_in_no_bus() -> None:
    code = (
        "import sys, rtid.kernels, rtid.estimator\n"
        "print({'can', 'serial', 'filterpy'} & set(sys.modules) or '')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == ""
