"""The recipes of docs/extending.md, through the command line."""

from __future__ import annotations

import gzip
import io
import json
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_bridge.frames import Frames
from firmware_bridge.sources import formats, open_log
from rtid.cli.exits import Exit
from rtid.effects import catalogue, page
from rtid.effects.live import LiveFlow
from rtid.maps.files import WRITERS
from rtid.project import load
from rtid.sim.hidden import hide_wish
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study import kept
from rtid.study.on_board import on_board
from tests.command import ends, in_json
from tests.replays import shared_replays  # noqa: F401

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"
TRACE = Path("the trace")
EACH_APART = True  # `replays`: what is installed for one test is no other one's
GAP = """
[effects.gap]
flow = "p_a - p_b"
unit = "m3/s/Pa"
chambers = { a = -1, b = 1 }
largest = 1e-9
"""


def snippets(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(), re.M | re.S)


def snippet(language: str, word: str) -> str:
    """The one with that word."""
    (found,) = (code for code in snippets(language) if word in code)
    return found


@pytest.fixture(scope="module")
def leaking(tmp_path_factory: pytest.TempPathFactory) -> Path:
    trace = tmp_path_factory.mktemp("own") / "leak.parquet"
    plant = hide_wish(SimulatedPlant(), "internal_leakage_laminar=middle")
    write_run(trace, simulate(plant, "rich", 0, 30.0), 0, "rich")
    return trace


def install(folder: Path, name: str, group: str, lines: str) -> None:
    """What pip leaves of a package that brings entry points."""
    info = folder / f"{name}-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{lines}")


def project(leaking: Path, folder: Path, more: str) -> Path:
    file = folder / "machine.toml"
    file.write_text(leaking.with_suffix(".toml").read_text() + "\n" + more)
    return file


def test_own_effects_are_scored_named_added_dropped_and_run_on_board(
    leaking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = project(leaking, tmp_path, GAP + snippet("toml", "[effects.worn_groove]"))
    said = in_json("diagnose", leaking, "-p", file)
    first = said["found"][0]
    assert {first["effect"], *first["cannot_be_told_from"]} >= {"gap", "internal_leakage_laminar"}
    assert first["where"] == "a-b"
    seen = {(u["effect"], u["where"]) for u in said["not_found"]}
    assert ("worn_groove", "a-b") in seen or "worn_groove" in first["cannot_be_told_from"]
    done = in_json("add", "gap", leaking, "-p", file)
    assert [(c["effect"], c["where"]) for c in done["changes"]] == [("gap", "a-b")]
    words = "add", "worn_groove", leaking, "-p", file, "--force", "--json"
    assert ends(*words) == Exit.OK, capsys.readouterr().err
    gap, groove = load(file).sections.added
    assert (gap.effect, groove.effect, groove.where) == ("gap", "worn_groove", "a-b")
    assert set(groove.parameters) == {"coefficient", "x0"} and groove.parameters["x0"].unit == "m"
    told: list[str] = []
    board = on_board(load(file), told.append)
    kernel, beside = board.model.terms
    assert dict(kernel.weights) == {"p_a": 1.0, "p_b": -1.0} and kernel.shape == "linear"
    assert kernel.scale == pytest.approx(gap.parameters["coefficient"].value)
    assert dict(beside.signs) == {"a": -1, "b": 1} and len(board.flows) == 1
    assert told == [
        "gap at a-b is learned beside the maps",
        "worn groove at a-b is learned beside the maps, its flow computed sample by sample",
    ]
    capsys.readouterr()
    assert ends("drop", "worn_groove", leaking, "-p", file, "--json") == Exit.OK
    (gap,) = load(file).sections.added
    assert gap.parameters["coefficient"].value == pytest.approx(2e-12, rel=0.2)


def test_an_own_effect_in_python_is_added_and_runs_on_board(leaking: Path, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(snippet("python", "def worn_groove"))
    file = project(leaking, tmp_path, "")
    text = file.read_text().replace("[project]", '[project]\neffects_module = "own.py"', 1)
    file.write_text(text)
    assert ends("add", "worn_groove", leaking, "-p", file, "--force") == Exit.USAGE
    assert ends("trust", file) == Exit.OK
    assert ends("add", "worn_groove", leaking, "-p", file, "--force") == Exit.OK
    told: list[str] = []
    (flow,) = on_board(load(file), told.append).flows
    assert isinstance(flow, LiveFlow)
    assert "its flow computed sample by sample" in told[0] and dict(flow.shape).keys() == {"x0"}


@pytest.fixture
def my_effects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package of the recipe: one page, and an entry point that names it."""
    package = tmp_path / "my_effects"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "worn_end.toml").write_text(snippet("toml", "Worn end"))
    entries = tomllib.loads(snippet("toml", "rtid.effects"))["project"]["entry-points"]
    (entry,) = entries["rtid.effects"].items()
    install(tmp_path, "my_effects", "rtid.effects", f"{entry[0]} = {entry[1]}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "my_effects", raising=False)
    catalogue.cache_clear()
    yield
    catalogue.cache_clear()


def test_an_effect_of_a_plug_in_is_one_of_the_catalogue(
    leaking: Path, tmp_path: Path, my_effects: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """One page: explained, scored, added, on board; what looks alike says so too."""
    assert ends("effects", "worn_end") == Exit.OK
    assert "Worn end of the stroke" in capsys.readouterr().out
    assert "worn_end" in catalogue()["internal_leakage_laminar"].confounders
    file = project(leaking, tmp_path, "")
    words = "add", "worn_end", leaking, "-p", file, "--force", "--json"
    assert ends(*words) == Exit.OK, capsys.readouterr().err
    (added,) = load(file).sections.added
    assert (added.where, set(added.parameters)) == ("a-b", {"coefficient", "begin"})
    assert 0.0 <= added.parameters["begin"].value <= 2.0
    assert added.parameters["coefficient"].unit == "m3/s/Pa/m"
    told: list[str] = []
    assert on_board(load(file), told.append).flows and told[0].startswith("Worn end of the stroke")
    assert ends("drop", "worn_end", "-p", file) == Exit.OK


def test_a_plug_in_may_define_its_effects_in_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my_grooves.py").write_text(snippet("python", "def worn_groove"))
    install(tmp_path, "my_grooves", "rtid.effects", "grooves = my_grooves\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    catalogue.cache_clear()
    try:
        assert ends("effects", "worn_groove") == Exit.OK
        assert "Leaks beyond x0." in capsys.readouterr().out
        listed = {e["name"]: e for e in in_json("effects")["effects"]}
    finally:
        catalogue.cache_clear()
    assert listed["worn_groove"]["into"] == [["a", -1], ["b", 1]]


def test_a_plug_in_that_fails_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, "broken", "rtid.effects", "x = no_such_package\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    catalogue.cache_clear()
    try:
        assert ends("effects") == Exit.USAGE
    finally:
        catalogue.cache_clear()
    told = capsys.readouterr().err
    assert "the plug-in no_such_package: it does not load" in told and "uninstall" in told


@pytest.mark.parametrize(
    ("word", "wrong", "words"),
    [
        ('kind = "flow"', 'kind = "leak"', "its kind 'leak' is none of flow, "),
        ('"internal_leakage_laminar"', '"internal"', "worn_end looks like 'internal', which is no"),
    ],
)
def test_a_page_of_a_plug_in_that_is_wrong_is_named(
    my_effects: None, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    word: str, wrong: str, words: str,
) -> None:  # fmt: skip
    page = tmp_path / "my_effects" / "worn_end.toml"
    page.write_text(page.read_text().replace(word, wrong))
    assert ends("effects") == Exit.USAGE
    said = capsys.readouterr().err
    assert words in said and "worn_end" in said


@pytest.fixture
def own_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (entry,) = tomllib.loads(snippet("toml", "rtid.formats"))["project"]["entry-points"][
        "rtid.formats"
    ].items()
    (tmp_path / "my_package.py").write_text(snippet("python", "MY LOGGER"))
    install(tmp_path, "my_package", "rtid.formats", f"{entry[0]} = {entry[1]}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "my_package", raising=False)
    formats.plugins.cache_clear()
    yield
    formats.plugins.cache_clear()


def write_mine(path: Path, frames: Frames) -> None:
    rows = zip(frames.t_us, frames.can_id, frames.data, strict=True)
    lines = [f"{1e-3 * float(t):.3f};{i:03X};{data.tobytes().hex()}" for t, i, data in rows]
    path.write_text("\n".join(["MY LOGGER", *lines]))


@pytest.mark.long
@pytest.mark.usefixtures("own_format")
def test_a_log_format_of_ones_own_goes_through_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the same result as BLF gives, by its suffix, by its content, packed, and from stdin."""
    folders = {kind: tmp_path / kind / "m1" for kind in ("blf", "mine")}
    for folder in folders.values():
        folder.mkdir(parents=True)
    blf_log, mine = folders["blf"] / "run.blf", folders["mine"] / "run.mine"
    write_run(blf_log, simulate(SimulatedPlant(), "rich", 0, 6.0), 0, "rich")
    file = blf_log.with_suffix(".toml")
    write_mine(mine, open_log(blf_log))
    unnamed, packed = tmp_path / "run", tmp_path / "run.mine.gz"
    unnamed.write_bytes(mine.read_bytes())
    packed.write_bytes(gzip.compress(mine.read_bytes()))

    def said(*words: object) -> Any:
        code = ends(*words)
        out, err = capsys.readouterr()
        assert code in (Exit.OK, Exit.NEGATIVE), err
        answer = json.loads(out)
        for where in ("trace", "path", "source", "elapsed_s", "speed", "file", "next"):
            answer.pop(where, None)
        return answer

    for words in (["check", "--bus-only", TRACE], ["check", file, TRACE], ["quick", TRACE],
                  ["replay", TRACE, "-p", file]):  # fmt: skip
        results = [
            said(*(log if word is TRACE else word for word in words), "--json")
            for log in (blf_log, mine)
        ]
        assert results[0] == results[1], words
    whole = said("check", "--bus-only", blf_log, "--json")
    for log in (unnamed, packed):
        assert said("check", "--bus-only", log, "--json") == whole
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(mine.read_bytes())))
    assert said("check", "--bus-only", "-", "--json") == whole
    ranked = [
        said("fleet", folder.parent, "-p", file, "-o", tmp_path / f"{kind}.out",
             "--workers", 1, "--no-diagnose", "--json")
        for kind, folder in folders.items()
    ]  # fmt: skip
    assert ranked[0]["machines"] == ranked[1]["machines"]


@pytest.mark.usefixtures("own_format")
def test_what_a_reader_of_ones_own_does_wrong_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "run.mine"
    log.write_text("MY LOGGER\nnonsense\n")
    assert ends("check", "--bus-only", log) == Exit.INPUT
    assert re.search(
        r"run\.mine: not a readable log of my logger: .*unpack", capsys.readouterr().err
    )
    info = tmp_path / "my_package-1.dist-info"
    (info / "entry_points.txt").write_text("[rtid.formats]\nmine = my_package:ABSENT\n")
    formats.plugins.cache_clear()
    assert ends("check", "--bus-only", log) == Exit.INPUT
    assert "my_package:ABSENT does not load" in capsys.readouterr().err


@pytest.mark.parametrize("form", ["installed", "in a script"])
def test_an_export_of_ones_own_is_taken(
    leaking: Path, tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = snippet("python", "def write_lines")
    space: dict[str, Any] = {}
    if form == "installed":
        entry = tomllib.loads(snippet("toml", "rtid.export"))["project"]["entry-points"][
            "rtid.export"
        ]
        code = code.replace('WRITERS[".lines"] = write_lines', "")
        lines = "".join(f"{suffix} = {where}\n" for suffix, where in entry.items())
        (tmp_path / "my_package.py").write_text(code)
        install(tmp_path, "my_package", "rtid.export", lines)
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, "my_package", raising=False)
    else:
        monkeypatch.setattr("rtid.maps.files.WRITERS", WRITERS)
        exec(compile(code, str(PAGE), "exec"), space)
    file = project(leaking, tmp_path, "")
    try:
        assert ends("export", leaking, tmp_path / "map.lines", "-p", file) == Exit.OK
    finally:
        WRITERS.pop(".lines", None)
    assert set(json.loads((tmp_path / "map.lines").read_text())) == {"pa", "at", "pb", "bt"}


PACKAGE = {
    "slow_gap.toml": """
title = "Gap that opens slowly"
kind = "flow"
places = ["both chambers"]
summary = "The seal creeps: it leaks after the pressure."
equation = ["q_a = -C_s * lag(p_a - p_b, tau)", "q_b = C_s * lag(p_a - p_b, tau)"]
law = "my_laws.gap:slow_gap"
signals = ["p_a", "p_b"]
signature = "The residual follows the pressure of some moments ago."
confounders = ["internal_leakage_laminar"]
separates = "A hold behind a fast change of load."
visible_when = "The load changes while the seal settles."
reference = "none"

[[parameters]]
name = "coefficient"
symbol = "C_s"
unit = "m3/s/Pa"
low = 1e-14
high = 1e-9
sign = 1
meaning = "leakage coefficient once the seal has settled"

[[parameters]]
name = "settling"
symbol = "tau"
unit = "s"
low = 0.02
high = 5.0
sign = 1
start = [0.1, 0.3, 1.0]
meaning = "time constant of the seal"
""",
    "__init__.py": "",
}


@pytest.fixture
def my_laws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package with one page whose law is the recipe's."""
    package = tmp_path / "my_laws"
    package.mkdir()
    for name, text in PACKAGE.items():
        (package / name).write_text(text)
    (package / "gap.py").write_text(snippet("python", "def slow_gap"))
    install(tmp_path, "my_laws", "rtid.effects", "gap = my_laws\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("my_laws", "my_laws.gap"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    catalogue.cache_clear()
    yield package
    catalogue.cache_clear()


@pytest.mark.long
def test_an_effect_with_a_law_of_ones_own_goes_the_whole_way(
    leaking: Path, tmp_path: Path, my_laws: Path
) -> None:
    """Its equation is words for a reader: no command takes it for a law that it cannot read."""
    file = project(leaking, tmp_path, "")
    said = in_json("diagnose", leaking, "-p", file)
    seen = {u["effect"] for u in said["not_found"]}
    assert "slow_gap" in seen | {n for f in said["found"] for n in f["cannot_be_told_from"]}
    assert ends("add", "slow_gap", leaking, "-p", file, "--force") == Exit.OK
    assert load(file).sections.added[0].parameters.keys() == {"coefficient", "settling"}
    told: list[str] = []
    on_board(load(file), told.append)
    assert "is not in the model on board, because it needs a record" in told[0]
    assert ends("compare", leaking, "-p", file) in (Exit.OK, Exit.NEGATIVE)


@pytest.mark.long
def test_what_a_plug_in_changes_is_seen_though_a_fit_was_kept(
    leaking: Path, tmp_path: Path, my_laws: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert kept.PLUGINS == (page.PLUGINS, formats.PLUGINS)
    file = project(leaking, tmp_path, "")
    words = "diagnose", leaking, "-p", file, "--json"
    assert ends(*words) == Exit.OK
    changed = my_laws / "slow_gap.toml"
    changed.write_text(changed.read_text().replace("gap:slow_gap", "gap:nobody"))
    catalogue.cache_clear()
    capsys.readouterr()
    assert ends(*words) == Exit.USAGE
    assert "no law 'my_laws.gap:nobody'" in capsys.readouterr().err


def test_an_equation_that_cannot_be_read_is_named_with_its_effect(
    my_effects: None, leaking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "my_effects" / "worn_end.toml"
    page.write_text(page.read_text().replace("pos(x", "posi(x"))
    file = project(leaking, tmp_path, "")
    assert ends("add", "worn_end", leaking, "-p", file) == Exit.USAGE
    told = capsys.readouterr().err
    assert "the equation of worn_end: 'posi' is no known function" in told and "law = " in told


def test_the_effects_of_a_project_are_listed_and_explained_with_it(
    leaking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = project(leaking, tmp_path, GAP)
    assert ends("effects", "-p", file) == Exit.OK
    assert re.search(r"^  gap +gap +a-b", capsys.readouterr().out, re.M)
    assert ends("effects", "gap", "-p", file) == Exit.OK
    shown = capsys.readouterr().out
    assert "acts on: a-b" in shown and "q_b = coefficient" in shown
    assert "In the residual" not in shown
    assert ends("effects", "gap") == Exit.USAGE
    assert "-p" in capsys.readouterr().err
