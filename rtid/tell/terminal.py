"""The terminal: one console for all commands, tables readable at its width, charts as tables.

Of each series of a chart's points: a line of blocks, its ends, and the figure it stands for.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.table import Table as Grid
from rich.text import Text

from rtid.tell.story import FAINT, Bars, Chart, Dots, Planes, Story, Table

WIDTH = 110  # where the output is no terminal and COLUMNS says nothing
GAP = 2  # blanks between two columns
LEAST = 28  # characters that a column of words keeps before the table is taken apart
BLOCKS = "▁▂▃▄▅▆▇█"
BAR = 40  # longest bar, characters
EIGHTHS = " ▏▎▍▌▋▊▉"


class Terminal(Console):
    """A console that takes the parts of a story too."""

    def print(self, *objects: Any, **options: Any) -> None:
        """What `Console.print` does, tables and charts in their own form."""
        super().print(*(_drawn(part) for part in objects), **options)


def make_console() -> Terminal:
    """As wide as the terminal; where the output is none as COLUMNS says, else WIDTH.

    What is printed on it is taken as it is: names from outside may hold brackets and colons.
    """
    made = Terminal(highlight=False, markup=False, emoji=False)
    if made.is_terminal or os.environ.get("COLUMNS", "").isdecimal():
        return made
    return Terminal(highlight=False, markup=False, emoji=False, width=WIDTH)


class Printed(Table):
    """A table in which no figure is ever cut, at any width.

    Where it is too wide its headings break between words, then its columns of words do, and then
    it is continued below itself, with its key columns again.
    """

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The title and one table, or several below each other."""
        if self.title:
            yield Text(self.title, "table.title")
        for k, columns in enumerate(self._parts(options.max_width)):
            if k:
                yield ""
            yield self._table(columns, options.max_width)

    def _cells(self, column: int) -> Iterator[str]:
        return (row[column] for row in self.rows)

    def _least(self, column: int) -> int:
        """Characters that a column needs: its longest cell, and each word of its heading."""
        words = self.heads[column].rstrip("|~").split() or [""]
        longest = max((cell_len(cell) for cell in self._cells(column)), default=0)
        if self.heads[column].endswith("~"):
            longest = min(longest, LEAST)
        return max(longest, *(cell_len(word) for word in words))

    def _natural(self, column: int) -> int:
        """Characters of a column in which nothing breaks."""
        longest = max((cell_len(cell) for cell in self._cells(column)), default=0)
        return max(longest, cell_len(self.heads[column].rstrip("|~")))

    def _parts(self, width: int) -> Iterator[list[int]]:
        """Columns of each table that is printed, every one with the keys."""
        keys = list(range(self.keys))
        part, used = [*keys], sum(self._least(k) + GAP for k in keys)
        start = used
        for column in range(self.keys, len(self.heads)):
            needed = self._least(column)
            if used + needed > width and len(part) > self.keys:
                yield part
                part, used = [*keys], start
            part, used = [*part, column], used + needed + GAP
        yield part

    def _widths(self, columns: list[int], width: int) -> list[int]:
        """Characters of each column: what it needs, and a share of what is left, in their order."""
        widths = [self._least(c) for c in columns]
        rest = width - sum(widths) - GAP * (len(widths) - 1)
        for k, column in enumerate(columns):
            more = max(0, min(rest, self._natural(column) - widths[k]))
            if rest < 0 and self.heads[column].endswith("~"):  # a narrow window, long keys
                more = max(rest, 1 - widths[k])
            widths[k] += more
            rest -= more
        return widths

    def _table(self, columns: list[int], width: int) -> Grid:
        table = Grid(box=None, pad_edge=False, padding=(0, GAP, 0, 0), show_header=any(self.heads))
        for column, chars in zip(columns, self._widths(columns, width), strict=True):
            head = self.heads[column]
            table.add_column(
                Text(head.rstrip("|~")),
                justify="right" if head.endswith("|") else "left",
                width=chars,
                overflow="fold",
            )
        for row in self.rows:
            table.add_row(*(_text(row[c]) for c in columns))
        return table


def _text(cell: str) -> Text:
    return Text(cell, "dim" if cell.startswith(FAINT) else "")


def _drawn(part: Any) -> Any:
    """A story or a part of one as something that rich prints; anything else as it is."""
    if isinstance(part, Story):
        return Group(*_spaced(part))
    if isinstance(part, Chart):
        part = table_of(part)
    if isinstance(part, Bars):
        return Text("\n".join(bars(part)))
    if isinstance(part, Planes):
        return Text(part.caption)
    if isinstance(part, Table) and not isinstance(part, Printed):
        return Printed(part.title, part.heads, part.rows, part.keys)
    return part


def _spaced(story: Story) -> Iterator[Any]:
    """Its parts; what is drawn stands apart, a chart with its caption, a table that has rows."""
    if story.heading:
        yield Text(story.heading)
    is_first = not story.heading
    for part in story.parts:
        if isinstance(part, str):
            yield Text(part)
        elif not isinstance(part, Table) or part.rows:
            if not is_first:
                yield ""
            yield _drawn(part)
            if isinstance(part, Chart):
                yield Text(part.caption)
        is_first = False


def table_of(chart: Chart) -> Table:
    """The points of a chart: what they do from the left to the right, on one scale, and where."""
    panels = [panel for row in chart.panels for panel in row]
    low, high = _ends([points for panel in panels for points in panel.points])
    rows = [
        (panel.title if k == 0 else "", points.name, _blocks(points, low, high),
         f"{points.y[0]:.3g} to {points.y[-1]:.3g}" if len(points.y) else "", points.note)
        for panel in panels
        for k, points in enumerate(panel.points)
    ]  # fmt: skip
    heads = "over~", "model", "from left to right", f"{panels[0].y_label}|", "~"
    return Table(chart.title, heads, rows, keys=2)


def _ends(series: list[Dots]) -> tuple[float, float]:
    values = [float(y) for points in series for y in points.y]
    return min(values, default=0.0), max(values, default=0.0)


def _blocks(points: Dots, low: float, high: float) -> str:
    """A character for each point, the higher the larger."""
    span = (high - low) or 1.0
    steps = [round((len(BLOCKS) - 1) * (float(y) - low) / span) for y in points.y]
    return "".join(BLOCKS[step] for step in steps)


def bars(shown: Bars) -> list[str]:
    """A line per bar, and one of the limit, on one scale; none where nothing is above zero."""
    values = {bar.name: bar.value for bar in shown.bars}
    if shown.limit == shown.limit:
        values[shown.limit_name] = shown.limit
    largest = max(values.values(), default=0.0)
    if not largest > 0:
        return []
    return [f"  {name:7}{_bar(value / largest)} {value:.2f} %" for name, value in values.items()]


def _bar(share: float) -> str:
    whole, rest = divmod(round(8 * BAR * share), 8)
    return "█" * whole + EIGHTHS[rest].strip()
