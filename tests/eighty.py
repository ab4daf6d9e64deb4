"""Every table that a test prints is read at 80 columns: nothing of it may be cut."""

from __future__ import annotations

from collections.abc import Iterator
from io import StringIO

import pytest
from rich.console import Console, ConsoleOptions, RenderResult

from rtid.tell.terminal import LEAST, Printed

WIDTH = 80


def lines_of(table: Printed, width: int = WIDTH) -> list[str]:
    """What a terminal of this width shows."""
    file = StringIO()
    Console(file=file, width=width, markup=False, highlight=False).print(table)
    return file.getvalue().splitlines()


def require_whole(table: Printed, width: int = WIDTH) -> None:
    """Every figure and name on one line, every word of a heading and of a remark in whole."""
    lines = lines_of(table, width)
    words = {word for line in lines for word in line.split()}
    assert max(map(len, lines)) <= width, lines
    assert not any("…" in line for line in lines), lines
    assert {w for head in table.heads for w in head.rstrip("|~").split()} <= words, lines
    for row in table.rows:
        for head, text in zip(table.heads, row, strict=True):
            if head.endswith("~"):
                assert {w for w in text.split() if len(w) < LEAST} <= words, text
            else:
                assert any(text in line for line in lines), (text, lines)


@pytest.fixture
def eighty(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Printed]]:
    """The tables that are printed in this test, all held against `require_whole`; at least one."""
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    printed: list[Printed] = []
    show = Printed.__rich_console__

    def seen(table: Printed, console: Console, options: ConsoleOptions) -> RenderResult:
        if console.width <= WIDTH and table not in printed:
            printed.append(table)
        return show(table, console, options)

    monkeypatch.setattr(Printed, "__rich_console__", seen)
    yield printed
    assert printed
    monkeypatch.undo()
    for table in printed:
        require_whole(table)
