"""Small parts of HTML that the views are made of; all words are escaped here."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape

from rtid.report_words import text


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


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of HTML cells; a heading that ends with "|" stands over figures."""
    top = "".join(f"<th>{text(word.rstrip('|'))}</th>" for word in head)
    kinds = [' class="n"' if word.endswith("|") else "" for word in head]
    body = "".join(
        "<tr>" + "".join(f"<td{k}>{c}</td>" for k, c in zip(kinds, row, strict=True)) + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


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
        found = json.loads(asked)
    except ValueError:
        return {}
    return {str(k): str(v) for k, v in found.items()} if isinstance(found, dict) else {}
