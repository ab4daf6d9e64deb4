"""[[added]] in the project file and the history beside it: bytes, comments, refusals."""

from __future__ import annotations

import os
import re
import shlex
import tomllib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

import pytest

import rtid.project
from rtid.cli.main import run
from rtid.errors import RtidError
from rtid.project import ProjectError, load
from rtid.project.added import (
    AddedSection,
    ChangeSection,
    ErrorsSection,
    ParameterSection,
    text_with,
)
from rtid.project.added import read as read_added
from rtid.project.history import ADD, Change, history, path_of, read, write
from rtid.study.revisions import drop, undo
from rtid.tell.story import Bar, Bars
from rtid.tell.terminal import bars

EXAMPLE = Path(rtid.project.__file__).parent / "examples" / "cylinder.toml"
LEAK = AddedSection(
    effect="internal_leakage_laminar",
    where="a-b",
    date=datetime(2026, 3, 1, 9, 30, tzinfo=UTC),
    trace="monday.blf",
    reason='named, "as expected"',
    parameters={"coefficient": ParameterSection(value=5.8e-12, sd=2e-13, unit="m3/s/Pa")},
    errors=ErrorsSection(heldout_pct=ChangeSection(before=1.31, after=0.39), noise_floor_pct=0.37),
)
RELIEF = LEAK.model_copy(
    update={
        "effect": "relief_valve",
        "where": "a",
        "parameters": {
            "slope": ParameterSection(value=1e-11, sd=1e-12, unit="m3/s/Pa"),
            "opening_pressure": ParameterSection(value=7e6, unit="Pa"),
        },
    }
)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    path = tmp_path / "machine.toml"
    path.write_bytes(EXAMPLE.read_bytes() + b"\n# my own last words\n")
    return path


def change(section: AddedSection, before: str) -> Change:
    return Change(
        0, "2026-03-01T09:30:00+00:00", ADD, section.effect, section.where, section.reason,
        section.trace, section.model_dump(mode="json", exclude_none=True), {}, None, before, "",
    )  # fmt: skip


def added(project: Path, *sections: AddedSection) -> str:
    """Add the sections as one change each; the text of the file."""
    steps, known = [], load(project).sections.added
    text = project.read_bytes().decode()
    for section in sections:
        known = (*known, section)
        before, text = text, text_with(text, known)
        steps.append((change(section, before), text))
    write(project, steps)
    return text


def test_sections_come_back_as_they_were_and_comments_stay(project: Path) -> None:
    old = project.read_text()
    text = added(project, LEAK, RELIEF)
    assert text.startswith(old)
    assert load(project).sections.added == (LEAK, RELIEF)
    assert load(project).digest == load(EXAMPLE).digest, "the machine itself is the same"


def test_new_parameters_change_nothing_else(project: Path) -> None:
    text = added(project, LEAK, RELIEF).replace('where = "a-b"', 'where = "a-b"  # seen by Anna')
    moved = {"coefficient": ParameterSection(value=6e-12, sd=1e-13, unit="m3/s/Pa")}
    again = text_with(text, (LEAK.model_copy(update={"parameters": moved}), RELIEF))
    assert again == text.replace("5.8e-12", "6e-12").replace("sd = 2e-13", "sd = 1e-13")


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_taking_out_what_was_put_in_leaves_the_rest(ending: str) -> None:
    old = EXAMPLE.read_text().replace("\n", ending)
    both = text_with(old, (LEAK, RELIEF))
    assert text_with(both, (RELIEF,)) == text_with(old, (RELIEF,))
    assert text_with(both, ()).rstrip() == old.rstrip()


@pytest.mark.parametrize(
    ("table", "path"),
    [
        ({"where": "a", "parameters": {"c": {"value": 1.0, "unit": "1"}}}, "added[0].effect"),
        ({"effect": "x", "where": "a"}, "added[0].parameters"),
        (
            {"effect": "x", "where": "a", "parameters": {"c": {"value": "1", "unit": "1"}}},
            "added[0].parameters.c.value",
        ),
        (
            {
                "effect": "x",
                "where": "a",
                "parameters": {"c": {"value": 1.0, "unit": "1"}},
                "errors": {"rho": {"before": -1.0}},
            },
            "added[0].errors.rho.before",
        ),
    ],
)
def test_an_error_is_named_by_its_key_path(table: dict[str, Any], path: str) -> None:
    sections, problems = read_added([table])
    assert not sections
    assert [p.path for p in problems] == [path] and problems[0].remedy


def test_the_same_effect_twice_is_refused(project: Path) -> None:
    text = added(project, LEAK)
    start = text.index("[[added]]")
    project.write_text(text + "\n" + text[start:])
    with pytest.raises(ProjectError, match=r"added\[1\]: is added twice"):
        load(project)


def test_two_changes_then_two_undos_then_none_is_left(project: Path) -> None:
    old = project.read_bytes()
    one = added(project, LEAK)
    added(project, RELIEF)
    assert undo(project).changes[0].undoes == 2
    assert project.read_bytes() == one.encode()
    assert undo(project).changes[0].undoes == 1
    assert project.read_bytes() == old
    with pytest.raises(RtidError, match="no change to undo") as refused:
        undo(project)
    assert "rtid add" in refused.value.remedy
    assert [(c.number, c.change) for c in history(project)] == [
        (1, "add"), (2, "add"), (3, "undo"), (4, "undo"),
    ]  # fmt: skip


def test_drop_and_undo_of_it(project: Path) -> None:
    text = added(project, LEAK, RELIEF)
    assert drop(project, "relief_valve", dry_run=True).is_written is False
    assert project.read_bytes() == text.encode()
    drop(project, "relief_valve", reason="it was the hose")
    assert load(project).sections.added == (LEAK,)
    assert history(project)[-1].reason == "it was the hose"
    undo(project)
    assert project.read_bytes() == text.encode()


def test_drop_names_what_is_there(project: Path) -> None:
    added(project, LEAK, RELIEF)
    with pytest.raises(RtidError, match="not part of the model") as caught:
        drop(project, "internal_leakage_turbulent")
    assert "internal_leakage_laminar:a-b" in caught.value.remedy
    added(project, RELIEF.model_copy(update={"where": "b"}))
    with pytest.raises(RtidError, match="several places"):
        drop(project, "relief_valve")
    drop(project, "relief_valve", "b")
    assert load(project).sections.added == (LEAK, RELIEF)


def test_undo_keeps_what_was_edited_since(project: Path) -> None:
    old = project.read_text()
    text = added(project, LEAK)
    project.write_text(text.replace("# my own last words", "# edited since"))
    done = undo(project)
    assert "edited since" in done.note
    edited = old.replace("# my own last words", "# edited since")
    assert project.read_text().rstrip() == edited.rstrip()


def test_undo_of_a_drop_keeps_what_was_edited_since(project: Path) -> None:
    added(project, LEAK, RELIEF)
    drop(project, "internal_leakage_laminar")
    project.write_text(project.read_text().replace("# my own last words", "# edited since"))
    assert undo(project).note
    assert load(project).sections.added == (RELIEF, LEAK)
    assert "# edited since" in project.read_text()


def test_a_read_only_file_is_left_alone(project: Path) -> None:
    text = added(project, LEAK)
    for path in (project, path_of(project)):
        path.chmod(0o444)
        with pytest.raises(RtidError, match="read-only"):
            drop(project, LEAK.effect)
        with pytest.raises(RtidError, match="read-only"):
            undo(project)
        path.chmod(0o644)
    assert project.read_bytes() == text.encode()
    assert len(read(project)) == 1


def test_nothing_is_written_when_something_fails(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = added(project, LEAK)
    lines = path_of(project).read_bytes()

    def fails(*_: object) -> NoReturn:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fails)
    with pytest.raises(OSError, match="disk full"):
        drop(project, LEAK.effect)
    assert project.read_bytes() == text.encode()
    assert path_of(project).read_bytes() == lines
    assert sorted(p.name for p in project.parent.iterdir()) == [
        "machine.history.jsonl", "machine.toml",
    ]  # fmt: skip


def test_a_file_that_changed_meanwhile_is_left_alone(project: Path) -> None:
    old = project.read_text()
    project.write_text(old + "# now\n")
    with pytest.raises(RtidError, match="changed meanwhile"):
        write(project, [(change(LEAK, old), text_with(old, (LEAK,)))])
    assert project.read_text() == old + "# now\n"
    assert not path_of(project).exists()


def test_a_damaged_history_is_named_by_line(project: Path) -> None:
    added(project, LEAK)
    with path_of(project).open("a") as file:
        file.write('{"number": 2\n')
    with pytest.raises(RtidError, match=r"machine\.history\.jsonl: line 2"):
        history(project)


def test_a_link_stays_a_link_and_rights_stay(project: Path) -> None:
    link = project.parent / "current.toml"
    link.symlink_to(project)
    project.chmod(0o640)
    added(link, LEAK)
    assert link.is_symlink() and project.stat().st_mode & 0o777 == 0o640
    assert tomllib.loads(project.read_text())["added"][0]["effect"] == LEAK.effect
    assert len(history(project)) == 1


def test_bars_have_one_scale() -> None:
    shown = (Bar("before", 2.0), Bar("after", 0.5))
    before, after, floor = bars(Bars("", "", shown, 0.25, "floor", "share of the flow"))
    assert (before.count("█"), after.count("█"), floor.count("█")) == (40, 10, 5)
    assert before.endswith(" 2.00 %") and floor.startswith("  floor")


def test_the_line_that_takes_a_change_back_can_be_pasted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the folder, quoted, and in one piece however long it is."""
    folder = tmp_path / "the press's records" / ("of the long year " * 6).strip()
    folder.mkdir(parents=True)
    project = folder / "worn.toml"
    project.write_text(text_with(EXAMPLE.read_text("utf-8"), (LEAK,)), "utf-8")
    untouched = project.read_bytes()
    with pytest.raises(SystemExit, match="0"):
        run(["drop", LEAK.effect, "-p", str(project)])
    assert project.read_bytes() != untouched
    (line,) = re.findall(r"`(rtid undo[^`]*)` takes it back", capsys.readouterr().out)
    with pytest.raises(SystemExit, match="0"):
        run(shlex.split(line)[1:])
    assert project.read_bytes() == untouched
