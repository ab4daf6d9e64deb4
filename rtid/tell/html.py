"""Stories as HTML, and the small parts that the views of the page are made of.

All words are escaped here.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from math import isfinite, log10
from pathlib import Path

from rtid.tell.story import Bars, Story, StoryPart, Table

INSIDE = 25.0  # % of the track from which a bar has its figure inside
TENS = 99.5  # standard deviations from which no decimals are told
WIDEST = 150.0  # pixels of the longest bar of a ranking


def text(words: str) -> str:
    """Words as HTML."""
    return escape(words)


def rendered(story: Story, charts: Mapping[str, str]) -> str:
    """A section of a report; charts: the places of its plots by name."""
    content = "".join(_part(part, charts) for part in story.parts)
    heading = f"<h2>{text(story.heading)}</h2>" if story.heading else ""
    return f"<section>{heading}{content}</section>" if heading else content


def _part(part: StoryPart, charts: Mapping[str, str]) -> str:
    if isinstance(part, str):
        return f"<p>{text(part)}</p>"
    if isinstance(part, Table):
        heading = f"<h3>{text(part.title)}</h3>" if part.title else ""
        return heading + table(part.heads, ([text(c) for c in row] for row in part.rows))
    drawn = bars(part) if isinstance(part, Bars) else charts[part.name]
    return f"<figure>{drawn}<figcaption>{text(part.caption)}</figcaption></figure>"


def bars(shown: Bars) -> str:
    """Bars as HTML: of an error against its floor, or of a ranking."""
    if not shown.is_log:
        errors = [(b.name, b.value, b.kind == "foretold") for b in shown.bars]
        return error_bars(errors, shown.limit)
    most = max((b.value or b.after or 0.0 for b in shown.bars), default=1.0) or 1.0
    rows = [(text(b.name), *clearness(b.value or None, b.after, most)) for b in shown.bars]
    return table(("effect", "how clearly|", ""), rows)


def static(*names: str) -> str:
    """Style sheets or scripts of the page, one after the other."""
    return "".join((Path(__file__).parent / "static" / n).read_text("utf-8") for n in names)


def error_bars(shown: Sequence[tuple[str, float, bool]], floor: float) -> str:
    """Name, error in % and whether it is only expected, against the sensors' floor in %."""
    known = [value for _, value, _ in shown if isfinite(value)]
    has_floor = isfinite(floor)
    most = 1.12 * max(*known, floor if has_floor else 0.0, 1e-9)
    rows, before = "", 100.0
    for k, (name, value, is_foretold) in enumerate(shown):
        width = 100 * value / most if isfinite(value) else 0.0
        kind = "first" if k == 0 and len(shown) > 1 else "foretold" if is_foretold else ""
        line = f'<div class="floor" style="left:{100 * floor / most:.2f}%"></div>'
        rows += _bar(name, value, kind, width, before, line if has_floor else "")
        before = width
    return f'<div class="bars">{rows}</div>'


def _bar(name: str, value: float, kind: str, width: float, start: float, floor: str) -> str:
    """One bar, `width` % of the track; it grows or shrinks from `start`; floor: the dashed line."""
    is_long = width > INSIDE
    place = f"right:{100 - width:.2f}%" if is_long else f"left:{width:.2f}%"
    return (
        f'<div class="name">{text(name)}</div><div class="track"><div class="bar {kind}" '
        f'style="width:{width:.2f}%;--from:{start:.2f}%" data-error="{value:.4f}"></div>'
        f'<span class="{"in" if is_long else ""}" style="{place}">{value:.2f} %</span>'
        f"{floor}</div>"
    )


def clearness(before: float | None, after: float | None, most: float) -> tuple[str, str]:
    """How clearly a record shows an effect, in standard deviations, as words and as a bar.

    after: once the found one is in the model; None: it is the found one, or none was.
    """
    value = before if before is not None else after or 0.0
    width = WIDEST * _log(value) / max(_log(most), 1e-9)
    mark = " own" if after is None else ""
    words = f"{value:.3g}" if value < TENS else f"{value:.0f}"
    if after is not None and abs(after - value) > 0.05 * value:
        words += f" → {after:.2g}"
    return words, f'<span class="clear{mark}" style="width:{width:.0f}px"></span>'


def _log(value: float) -> float:
    return log10(max(value, 1.0)) if value >= 1 else 0.02


def button(label: str, do: str, *, kind: str = "", off: bool = False, **data: str) -> str:
    """A button that asks the server to `do` something with `data`."""
    more = "".join(f' data-{key}="{escape(value)}"' for key, value in data.items())
    state = " disabled" if off else ""
    return f'<button class="{kind}" data-do="{do}"{more}{state}>{text(label)}</button>'


def choice(do: str, options: Sequence[str], chosen: str, key: str = "name") -> str:
    """A row of buttons of which one is pressed."""
    made = (
        f'<button data-do="{do}" data-{key}="{escape(o)}" id="{do}_{k}" '
        f'aria-pressed="{str(o == chosen).lower()}">{text(o)}</button>'
        for k, o in enumerate(options)
    )
    return f'<span class="choice">{"".join(made)}</span>'


def select(do: str, options: Mapping[str, str] | Sequence[str], chosen: str, label: str) -> str:
    """A list of which one is chosen; options: words by value."""
    words = options if isinstance(options, Mapping) else {o: o for o in options}
    made = "".join(
        f'<option value="{escape(v)}"{" selected" if v == chosen else ""}>{text(w)}</option>'
        for v, w in words.items()
    )
    return (
        f'<label>{text(label)} <select id="{do}_select" data-do="{do}" '
        f'autocomplete="off">{made}</select></label>'
    )


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table of HTML cells; a heading that ends with "|" stands over figures.

    kind: a class that the style sheet knows.
    """
    kinds = [' class="n"' if word.endswith("|") else "" for word in head]
    top = "".join(
        f"<th{k}>{text(word.rstrip('|~'))}</th>" for k, word in zip(kinds, head, strict=True)
    )
    body = "".join(
        "<tr>" + "".join(f"<td{k}>{c}</td>" for k, c in zip(kinds, row, strict=True)) + "</tr>"
        for row in rows
    )
    made = f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="wide {kind}">{made}</div>'


def cover(heading: str, words: Iterable[str], share: float | None = None) -> str:
    """What stands in place of pictures while there are none."""
    bar = "" if share is None else f'<progress max="1" value="{share:.2f}"></progress>'
    return f"<h2>{text(heading)}</h2>{''.join(f'<p>{text(w)}</p>' for w in words)}{bar}"


def changed(old: dict[str, str], new: Mapping[str, str]) -> dict[str, str]:
    """What differs, also put into `old`."""
    parts = {key: value for key, value in new.items() if old.get(key) != value}
    old.update(parts)
    return parts


def parsed(asked: str) -> dict[str, str]:
    """What a page asks, every value as a word; empty where it is no such message."""
    try:
        value = json.loads(asked)
    except ValueError:
        return {}
    return {str(k): str(v) for k, v in value.items()} if isinstance(value, dict) else {}
