"""One quiet look for every plot: few colours that every eye can tell apart, for light and dark.

Colours of text, axes and grids follow the page's theme in the browser (`static/page.js`); a glyph
with the tag INK does too.
"""

from __future__ import annotations

from typing import Any

from bokeh.layouts import row
from bokeh.models import DataRange1d, GlyphRenderer, NoOverlap, Row, Title, UIElement
from bokeh.plotting import figure

NARROW_PX, NARROWEST_PX = 900, 560  # widths of the page below which less stands side by side
FIGURES_TAG = "figures"  # text that the browser turns or leaves out where its block is too small
APART_PX = 2  # between the words of two ticks
LIT = "#cc79a7"  # Okabe and Ito's purple: what the user has pointed at
INK_TAG = "ink"
NOTE_TAG = "note"  # a title that keeps its colour


def plot(
    y_label: str = "", x_label: str = "", x_range: Any = None, title: str = "", **more: Any
) -> figure:
    """An empty plot without ornament."""
    made = figure(
        x_range=x_range or DataRange1d(range_padding=0.02),
        y_axis_label=y_label or None,
        x_axis_label=x_label or None,
        toolbar_location=None,
        sizing_mode="stretch_both",
        background_fill_alpha=0.0,
        border_fill_alpha=0.0,
        outline_line_color=None,
        min_border_left=64,
        min_border_right=8,
        min_border_top=4,
        min_border_bottom=2,
        **({"tools": ""} | more),
    )
    made.center.remove(made.xgrid[0])
    made.ygrid.grid_line_alpha = 0.35
    for axis in (*made.xaxis, *made.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = "11px"
        axis.axis_label_standoff = 4
        axis.major_label_text_font_size = "10px"
        axis.minor_tick_line_color = None
        axis.major_tick_in, axis.major_tick_out = 0, 4
        axis.axis_line_width = 0.7
        axis.major_label_policy = NoOverlap(min_distance=APART_PX)
    made.title = styled(Title(text=title))
    return made


def lean(drawn: GlyphRenderer) -> GlyphRenderer:
    """What is drawn in one way alone: nobody selects or mutes it, and a page has many."""
    drawn.nonselection_glyph = drawn.muted_glyph = None
    return drawn


def styled(title: Title) -> Title:
    """A title in the common type."""
    title.text_font_size, title.text_font_style, title.offset = "11.5px", "bold", -2
    return title


def beside(*made: UIElement, stacked_below_px: int = NARROW_PX) -> Row:
    """Side by side; one below the other where the page is narrower than that."""
    narrow = f"@media screen and (max-width: {stacked_below_px}px)"
    stacked = ":host { flex-direction: column !important; }"
    return row(*made, sizing_mode="stretch_both", stylesheets=[f"{narrow} {{ {stacked} }}"])
