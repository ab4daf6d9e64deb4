"""What is said to a person, as plain data: sentences, tables and charts, told once for all media.

Four renderers draw it, each in its own medium: `terminal` (rich), `live` (Bokeh: the page, and the
plots of a report), `stills` (matplotlib) and `html`.  A chart holds its numbers in the units in
which they are shown, and its caption is the sentence that says what is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from rtid.plain import FloatArray

Common = Literal["all", "row", "none"]
Palette = Literal["flow", "doubt", "change"]
FAINT = "~"  # begins a cell that is not known well yet


@dataclass(frozen=True)
class Table:
    """Cells that are taken as they are: no markup; one that begins with FAINT is shown paler.

    heads: one that ends with "|" stands over figures, one that ends with "~" over words, which may
    break into lines.  keys: so many first columns say what a row is about.
    """

    title: str
    heads: tuple[str, ...]
    rows: Sequence[Sequence[str]]
    keys: int = 1


@dataclass(frozen=True)
class Line:
    """y over x, both (n,); broken at NaN, and where a step of x is far longer than usual.

    name: in the legend, "" for none.
    """

    name: str
    x: FloatArray
    y: FloatArray
    colour: str
    width: float = 1.0
    is_dashed: bool = False


@dataclass(frozen=True)
class Dots:
    """Means y over x with the half width `error` of their 95 % intervals, each (n,).

    error: None where they are no means.  note: the figure that the points stand for, in words.
    """

    name: str
    x: FloatArray
    y: FloatArray
    error: FloatArray | None
    colour: str
    marker: str = "o"  # or "s", a square, or "c", a circle that is not filled
    is_joined: bool = True
    note: str = ""


@dataclass(frozen=True)
class Shade:
    """A span of x on a ground of its own."""

    name: str
    low: float
    high: float
    colour: str


@dataclass(frozen=True)
class Strip:
    """The pale ground from low to high over x, each (n,); broken at NaN."""

    name: str
    x: FloatArray
    low: FloatArray
    high: FloatArray
    colour: str


@dataclass(frozen=True)
class Remark:
    """Words at x, above the panel, or behind the point (x, y); is_mark: with an upright line."""

    x: float
    text: str
    colour: str = ""
    is_mark: bool = False
    y: float | None = None


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    band: half height of a pale band about zero; has_zero: its line is drawn; ticks: words in place
    of the numbers 0, 1, ... of x; height: beside the other rows of the chart; limit: of y to either
    side, 0 for as the data are.
    """

    title: str
    x_label: str = ""
    y_label: str = ""
    lines: tuple[Line, ...] = ()
    points: tuple[Dots, ...] = ()
    shades: tuple[Shade, ...] = ()
    remarks: tuple[Remark, ...] = ()
    strips: tuple[Strip, ...] = ()
    band: float = 0.0
    has_zero: bool = True
    ticks: tuple[str, ...] = ()
    height: float = 1.0
    limit: float = 0.0


@dataclass(frozen=True)
class Chart:
    """Panels in rows and columns.

    name: of its file; caption: what is seen, in a sentence or two; common: whose panels have one
    scale of y, "all", "row" or "none"; band_name: of the panels' bands; size_in: of one panel;
    is_timed: x is the time of a record, and panels of a column are zoomed together.
    """

    name: str
    title: str
    panels: tuple[tuple[Panel, ...], ...]
    caption: str = ""
    common: Common = "all"
    band_name: str = ""
    size_in: tuple[float, float] = (5.0, 2.4)
    is_timed: bool = False


@dataclass(frozen=True)
class Plane:
    """Values (rows, columns) over y and x as colours, each in the middle of its own small field.

    x, y: both ends of an axis; low, high: ends of the scale; outline (m, 4): lines, from x, y to
    x, y; veiled (k, 4): fields, x, y, width and height, that do not stand on data of their own;
    points (n, 2): x and y of the data, where they are shown.
    """

    title: str
    x: tuple[float, float]
    y: tuple[float, float]
    values: FloatArray
    low: float
    high: float
    palette: Palette
    outline: FloatArray
    veiled: FloatArray
    points: FloatArray | None = None


@dataclass(frozen=True)
class Planes:
    """Planes over the same quantities and on one scale; its caption says what is seen."""

    name: str
    title: str
    planes: tuple[Plane, ...]
    x_label: str
    y_label: str
    value_label: str
    caption: str = ""
    outline_name: str = ""
    veil_name: str = ""


@dataclass(frozen=True)
class Bar:
    """A value with its name; kind: "first", "foretold", "found", "rival" or none of them.

    after: a second value of the same thing, shown as a point.
    """

    name: str
    value: float
    kind: str = ""
    after: float | None = None


@dataclass(frozen=True)
class Bars:
    """Bars of one scale, and a limit (dashed) that they are held against."""

    name: str
    title: str
    bars: tuple[Bar, ...]
    limit: float
    limit_name: str
    x_label: str
    caption: str = ""
    is_log: bool = False


StoryPart = str | Table | Chart | Planes | Bars


@dataclass(frozen=True)
class Story:
    """What there is to say of one thing, in its order."""

    heading: str
    parts: tuple[StoryPart, ...]
