"""The summary of the reproduced paper, and its command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from benchmarks.paper import parts
from benchmarks.paper.__main__ import main
from benchmarks.paper.result import Measure, Part, Table, all_met, at_least, at_most
from rtid.cli.exits import Exit


def part(limit: float = 2.0) -> Part:
    table = Table("Spacing:", ("a", "b"), (("1", "2"),))
    measures = (at_most("error", 1.25, limit, "%", "8 %"), Measure("blocks", 1584))
    return Part("fig9", "Fig. 9", "What was done.", measures, (table,), {"fig9": Figure()})


def test_goals() -> None:
    assert at_most("error", 1.0, 1.0).met
    assert not at_most("error", float("nan"), 1.0).met
    assert not at_least("share", 0.9, 1.0).met
    assert Measure("blocks", 1584).text == "1584"
    assert all_met([part()])
    assert not all_met([part(), part(limit=1.0)])


def test_markdown_and_pictures(tmp_path: Path) -> None:
    text = part(limit=1.0).markdown()
    assert "| error | 1.25 % | 8 % | at most 1 % | **no** |" in text
    assert "| blocks | 1584 |  |  |  |" in text
    assert "| 1 | 2 |" in text
    assert [p.name for p in part().save(tmp_path)] == ["fig9.png", "fig9.svg"]
    assert (tmp_path / "fig9.png").stat().st_size > 1000


def test_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(parts.PARTS, "fig3", lambda seed, plants: part())
    with pytest.raises(SystemExit) as end:
        main(["--out", str(tmp_path), "--only", "fig3", "--json"])
    assert end.value.code == Exit.OK
    told = json.loads(capsys.readouterr().out)
    assert told["all_met"]
    assert told == json.loads((tmp_path / "paper.json").read_text())
    assert "Fig. 9" in (tmp_path / "paper.md").read_text()
    assert (tmp_path / "fig9.svg").exists()


def test_a_goal_that_is_missed_is_a_negative_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(parts.PARTS, "fig3", lambda seed, plants: part(limit=1.0))
    with pytest.raises(SystemExit) as end:
        main(["--out", str(tmp_path), "--only", "fig3"])
    assert end.value.code == Exit.NEGATIVE
    assert "at most 1 %: MISSED" in capsys.readouterr().out


def test_unknown_part(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--only", "fig17"])
    assert end.value.code == Exit.USAGE
    assert "fig3" in capsys.readouterr().err
