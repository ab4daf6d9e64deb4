"""The pages in docs/: complete, and their snippets run."""

from __future__ import annotations

import json
import re
import shlex
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from firmware_bridge import checks, j1939, mended, stamps
from firmware_bridge.sources import blf_objects, slcan_lines, text
from firmware_bridge.sources.formats import suffixes
from rtid.cli import main
from rtid.cli.exits import Exit
from rtid.cli.export import RECORDED
from rtid.cli.teaching import EXAMPLES, PANELS, next_step
from rtid.daemon import wording
from rtid.diagnose import verdict
from rtid.effects import Effect
from rtid.estimator import blocks
from rtid.estimator.published import publish
from rtid.kernels import layout
from rtid.maps.files import WRITERS, write_map
from rtid.project import load
from rtid.project.schema import ExciteSection
from tests.command import ends
from tests.flow_maps import machine, orifice, solved
from tests.replays import shared_replays  # noqa: F401
from tools.api import PAGE, page

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def text_of(page: str) -> str:
    return (DOCS / page).read_text()


def words(page: str) -> set[str]:
    """What stands between backticks."""
    return set(re.findall(r"`([^`\n]+)`", text_of(page)))


def snippets(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), re.M | re.S)


def alarms() -> set[str]:
    """Names that the daemon's sources raise alarms under."""
    code = "".join(p.read_text() for p in (ROOT / "rtid" / "daemon").glob("*.py"))
    found = set(re.findall(r"alarms\.(?:put|set)\(\s*\"(\w+)\"", code))
    assert len(found) >= 7
    return found | {f"message_{v}" for v in wording.MESSAGES}


@pytest.mark.parametrize(
    "codes",
    [
        checks.REASONS, stamps.REASONS, j1939.REASONS, slcan_lines.REASONS, text.REASONS,
        blf_objects.REASONS, mended.REASONS, layout.COUNTERS,
        (blocks.EMPTY, blocks.LEARNING, blocks.VALID, blocks.STALE, blocks.INVALID),
        (verdict.MATCHES, verdict.MISSING, verdict.AMBIGUOUS, verdict.UNKNOWN,
         verdict.INSUFFICIENT),
    ],
    ids=[
        *("bridge", "stamps", "j1939", "slcan", "text", "blf", "mended", "estimator"),
        *("blocks", "verdicts"),
    ],
)  # fmt: skip
def test_every_code_stands_in_operations(codes: tuple[str, ...]) -> None:
    assert set(codes) <= words("operations.md")


def test_every_alarm_and_exit_code_stands_in_operations() -> None:
    assert alarms() <= words("operations.md")
    told = (DOCS / "operations.md").read_text().partition("## Exit codes")[2]
    assert all(f"{code.value} " in told for code in Exit)


@pytest.mark.parametrize(
    "page", ["theory.md", "architecture.md", "guide.md", "extending.md", "how-it-works.md"]
)
def test_files_that_a_page_names_exist(page: str) -> None:
    for name in re.findall(r"`((?:rtid|firmware_bridge|tests|docs)/[\w/.]+)`", text_of(page)):
        assert (ROOT / name).exists(), name


def test_the_architecture_names_every_package() -> None:
    packages = {str(p.parent.relative_to(ROOT)) for p in ROOT.glob("rtid/*/__init__.py")}
    assert len(packages) > 15
    assert packages <= words("architecture.md")


def test_the_page_of_formats_names_each_suffix() -> None:
    assert set(suffixes()) <= words("formats.md")


def test_the_snippets_of_extending_run(tmp_path: Path) -> None:
    (own,) = tomllib.loads(snippets("extending.md", "toml")[0])["effects"].values()
    assert own["chambers"] == {"a": -1, "b": 1}
    space: dict[str, Any] = {}
    for code in snippets("extending.md", "python"):
        exec(compile(code, "extending.md", "exec"), space)
        assert len(code.splitlines()) < 20
    try:
        assert isinstance(space["worn_groove"], Effect)
        assert space["needed"]
        flowmap = publish(solved(machine(edges=2), orifice, np.random.default_rng(0), rows=60))
        write_map(tmp_path / "map.lines", flowmap, {})
        assert set(json.loads((tmp_path / "map.lines").read_text())) == {"e0", "e1"}
    finally:
        WRITERS.pop(".lines", None)


def test_the_formula_of_extending_is_a_project_s_effect(tmp_path: Path) -> None:
    from rtid.sim.declare import declared_model
    from rtid.sim.project_file import project_text
    from rtid.sim.simulated_plant import SimulatedPlant

    project = tmp_path / "machine.toml"
    text_ = project_text(declared_model(SimulatedPlant()), 0.5, "simulated")
    project.write_text(text_ + "\n" + snippets("extending.md", "toml")[0])
    (effect,) = load(project).effects
    assert effect.name == "worn_groove"


def command(line: str) -> tuple[Any, list[str]]:
    """The command that a line calls, with its arguments."""
    program, name, *arguments = shlex.split(line)
    assert program == "rtid" and name in main.COMMANDS, line
    group: Any = typer.main.get_command(main.build([name]))
    return group.commands[name], arguments


def read(line: str) -> None:
    """Take the line apart as if it was run; a name or option that does not exist is an error."""
    found, arguments = command(line)
    found.make_context(found.name, arguments)


def test_every_command_has_an_example_and_a_place_in_the_help() -> None:
    assert set(EXAMPLES) == set(main.COMMANDS)
    assert sorted(name for names in PANELS.values() for name in names) == sorted(EXAMPLES)
    for name, example in EXAMPLES.items():
        assert example.split()[1] == name
        read(example)


@pytest.mark.parametrize("name", main.COMMANDS)
def test_no_help_loses_words_to_markup(name: str) -> None:
    """What stands in square brackets would be taken for a colour and not be shown."""
    found, _ = command(f"rtid {name}")
    texts = [found.help, found.epilog, *(getattr(p, "help", "") for p in found.params)]
    assert not [t for t in texts if t and re.search(r"\[[a-z/#@]", t)]
    assert all(getattr(p, "help", None) for p in found.params)


def test_the_help_of_excite_names_every_limit() -> None:
    told = command("rtid excite")[0].help
    for name in ExciteSection.model_fields:
        assert re.sub(r"_(m|s|mps|pa|kg|n|v)$", "", name) in told, name


def test_every_format_of_export_has_its_place_in_the_pages() -> None:
    known = {*WRITERS, *RECORDED, ".fmu", ".h"}
    assert known <= set(re.findall(r"`[^`\s]*?(\.\w+)`", (DOCS / "tools.md").read_text()))


@pytest.mark.parametrize("page", sorted(path.name for path in DOCS.glob("*.md")))
def test_links_between_the_pages_hold(page: str) -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", text_of(page)):
        assert (DOCS / target).exists(), target


def test_the_api_page_is_what_the_docstrings_say() -> None:
    assert PAGE.read_text() == page(), "run: python -m tools.api"


@pytest.mark.long
def test_the_notebook_tells_its_story(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its cells in their order in one namespace; the repository has it with its small outputs."""
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    text = (DOCS / "story.ipynb").read_text()
    assert len(text) < 60_000
    code = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    kept = [line for cell in code for out in cell["outputs"] for line in out.get("text", ())]
    assert any("image/png" in out.get("data", ()) for cell in code for out in cell["outputs"])
    space: dict[str, Any] = {}
    for cell in code:
        exec(compile("".join(cell["source"]), "story.ipynb", "exec"), space)
    before, after = (
        space[name].held[0].parts["validation"].residual_share for name in ("before", "after")
    )
    assert (after < 0.35 * before).all()
    printed = capsys.readouterr().out
    assert "internal_leakage_laminar at a-b" in printed
    assert len(kept) == len(printed.splitlines()), "run it again and keep its outputs"
    assert space["after"].held[0].beta_pa == pytest.approx(space["worn"].beta_pa, rel=0.02)


@pytest.mark.parametrize("outcome", [
    verdict.MATCHES, verdict.MISSING, verdict.AMBIGUOUS, verdict.UNKNOWN, verdict.INSUFFICIENT,
])  # fmt: skip
def test_what_is_next_goes_by_the_verdict(outcome: str) -> None:
    given = {"trace": Path("run.blf"), "project": Path("machine.toml")}
    step = next_step("diagnose", given, outcome)
    assert ("rtid add " in step) == (outcome == verdict.MISSING)
    commands = re.findall(r"rtid (\w+)", step)
    assert commands
    assert set(commands) <= set(EXAMPLES)


@pytest.mark.first_of(1)
@pytest.mark.parametrize("given", [
    ("drive.csv", "--example", "electric_drive"), ("room.csv", "--example", "heated_room"),
    ("run.parquet", "--duration", "2"),
])  # fmt: skip
def test_what_is_next_behind_a_simulation_can_be_typed(
    given: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ends("simulate", tmp_path / given[0], *given[1:])
    next_line = capsys.readouterr().out.splitlines()[-1]
    typed = shlex.split(next_line.removeprefix("Next: rtid "))
    with pytest.raises(SystemExit) as end:
        main.run(typed)
    said = capsys.readouterr()
    assert end.value.code in (Exit.OK, Exit.NEGATIVE), said.err  # two seconds are too little


def test_nothing_is_next_where_nothing_was_written(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["simulate", "--bus", "virtual", "--channel", "x", "--duration", "0.1", "--speed", "0"]
    ends(*words)
    assert "sent" in (said := capsys.readouterr().out) and "Next" not in said


def test_only_a_change_that_stands_can_be_taken_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = tmp_path / "machine.toml"
    project.write_text("")
    ends("history", "-p", project)
    assert "no change yet" in (said := capsys.readouterr().out)
    assert "Next: rtid diagnose" in said and "undo" not in said
    assert "rtid undo" in next_step("history", {"project": project}, "changed")
