"""What is printed is printed as it is: no text from outside is read as markup or as an emoji.

`rtid.daemon.coaching` says "a section [excite]", a DBC may call a
message "[/red]", somebody writes ":warning:" into a reason.
"""

from __future__ import annotations

import ast
import io
from dataclasses import replace
from pathlib import Path

import pytest

import rtid
from rtid.daemon.status import Advice, MessageHealth, SignalHealth, Verdict, write
from rtid.tell import replay as present
from tests.command import ends
from tests.daemon.test_parts import full_status

TOLD = "[excite] [/red] [bold]x[/bold] :warning: \\[y]"
ROOT = Path(rtid.__file__).parent


def test_status_prints_all_texts_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = full_status()
    alarm = replace(found.alarms[0], text=TOLD, trace=TOLD)
    estimate = replace(found.estimate, reason=TOLD)
    told = replace(
        found, name=TOLD, alarms=(alarm,), advice=Advice(1.0, TOLD), estimate=estimate,
        verdict=Verdict(1.0, "unknown", TOLD), store=replace(found.store, reason=TOLD),
        messages=(MessageHealth("[/red]", 1, 1.0),),
        signals=(SignalHealth("[bold]p", "pressure", ":bar:", "m"),),
    )  # fmt: skip
    write(tmp_path, told)
    ends("status", tmp_path)
    said = capsys.readouterr().out
    assert said.count(TOLD) == 7
    assert "[/red]  " in said and "[bold]p" in said and ":bar:" in said


def test_a_progress_bar_shows_names_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "120")
    shown = io.StringIO()
    monkeypatch.setattr("sys.stderr", shown)
    with present.progress_bar(hidden=False) as report:
        report(TOLD, 0.5)
    assert TOLD in shown.getvalue()


def constructions() -> list[tuple[str, ast.Call]]:
    """Every Console that the program makes."""
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        name = str(path.relative_to(ROOT))
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("Console"):
                found.append((name, node))
    return found


def test_no_console_reads_markup() -> None:
    """Where our own words are to be bold, `print(..., markup=True)` says so beside them."""
    bad = [
        f"{name}:{node.lineno}"
        for name, node in constructions()
        if not {"markup=False", "emoji=False"} <= {ast.unparse(k) for k in node.keywords}
    ]  # fmt: skip
    assert len(constructions()) > 3 and not bad
