"""The pages in docs/: complete, and their snippets run."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_bridge import checks, stamps
from firmware_bridge.sources import blf_objects, slcan_lines, text
from rtid.cli.exits import Exit
from rtid.daemon import wording
from rtid.diagnose import verdict
from rtid.effects import UserEffect
from rtid.estimator import blocks
from rtid.estimator.published import publish
from rtid.kernels import layout
from rtid.mapfiles import WRITERS, write_map
from tests.flow_maps import machine, orifice, solved

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def words(page: str) -> set[str]:
    """What stands between backticks."""
    return set(re.findall(r"`([^`\n]+)`", (DOCS / page).read_text()))


def snippets(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (DOCS / page).read_text(), re.M | re.S)


def alarms() -> set[str]:
    """Names that the daemon's sources raise alarms under."""
    code = "".join(p.read_text() for p in (ROOT / "rtid" / "daemon").glob("*.py"))
    found = set(re.findall(r"alarms\.(?:put|set)\(\s*\"(\w+)\"", code))
    assert len(found) >= 7
    return found | {f"message_{v}" for v in wording.MESSAGES}


@pytest.mark.parametrize(
    "codes",
    [
        checks.REASONS, stamps.REASONS, slcan_lines.REASONS, text.REASONS, blf_objects.REASONS,
        layout.COUNTERS,
        (blocks.EMPTY, blocks.LEARNING, blocks.VALID, blocks.STALE, blocks.INVALID),
        (verdict.MATCHES, verdict.MISSING, verdict.AMBIGUOUS, verdict.UNKNOWN,
         verdict.INSUFFICIENT),
    ],
    ids=["bridge", "stamps", "slcan", "text", "blf", "estimator", "blocks", "verdicts"],
)  # fmt: skip
def test_every_code_stands_in_operations(codes: tuple[str, ...]) -> None:
    assert set(codes) <= words("operations.md")


def test_every_alarm_and_exit_code_stands_in_operations() -> None:
    assert alarms() <= words("operations.md")
    told = (DOCS / "operations.md").read_text().partition("## Exit codes")[2]
    assert all(f"{code.value} " in told for code in Exit)


def test_files_that_the_theory_names_exist() -> None:
    for name in re.findall(r"`((?:rtid|tests|docs)/[\w/.]+)`", (DOCS / "theory.md").read_text()):
        assert (ROOT / name).exists(), name


def test_the_snippets_of_extending_run(tmp_path: Path) -> None:
    (own,) = tomllib.loads(snippets("extending.md", "toml")[0])["effects"].values()
    assert own["chambers"] == {"a": -1, "b": 1}
    space: dict[str, Any] = {}
    for code in snippets("extending.md", "python"):
        exec(compile(code, "extending.md", "exec"), space)
        assert len(code.splitlines()) < 20
    try:
        assert isinstance(space["worn_groove"], UserEffect)
        assert space["needed"]
        flowmap = publish(solved(machine(edges=2), orifice, np.random.default_rng(0), rows=60))
        write_map(tmp_path / "map.lines", flowmap, {})
        assert set(json.loads((tmp_path / "map.lines").read_text())) == {"e0", "e1"}
    finally:
        WRITERS.pop(".lines", None)


def test_the_formula_of_extending_is_a_project_s_effect(tmp_path: Path) -> None:
    from rtid.project import load
    from rtid.sim.declare import declared_model
    from rtid.sim.plant import Plant
    from rtid.sim.project_file import project_text

    project = tmp_path / "machine.toml"
    text_ = project_text(declared_model(Plant()), 0.5, "simulated")
    project.write_text(text_ + "\n" + snippets("extending.md", "toml")[0])
    (effect,) = load(project).effects
    assert effect.name == "worn_groove"
