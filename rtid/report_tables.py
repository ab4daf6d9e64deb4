"""The tables of the report page, and the small parts of HTML that the page is made of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from rtid.diagnose.regression import LIMIT_SD
from rtid.diagnose.report import Small, Unseen, Value
from rtid.diagnosed_text import quantity, title
from rtid.project.history import UNDO, Change, standing
from rtid.report_story import Ranked
from rtid.report_words import text


def section(heading: str, *content: str) -> str:
    """A section of the page; content: HTML."""
    return f"<section><h2>{escape(heading)}</h2>{''.join(content)}</section>"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of words."""
    top = "".join(f"<th>{text(word)}</th>" for word in head)
    body = "".join("<tr>" + "".join(f"<td>{text(c)}</td>" for c in row) + "</tr>" for row in rows)
    return (
        f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def named(key: tuple[str, str]) -> str:
    """Title and place of an effect."""
    return f"{title(key[0])} ({key[1]})" if key[1] else title(key[0])


def candidates(ranking: Sequence[Ranked]) -> str:
    """The figures of the ranking."""
    head = ("effect", "where", "sd before", "sd after", "coefficient", "detection limit")
    return table(head, (_candidate(one) for one in ranking))


def _candidate(one: Ranked) -> tuple[str, ...]:
    value = quantity(Value(one.value, one.std, one.unit))
    if one.per_shape is not None:
        value += f" of {_limit(*one.per_shape)}"
    if not one.is_possible:
        value += ", not possible"
    before = "" if one.before is None else f"{one.before:.1f}"
    after = "in the model" if one.after is None else f"{one.after:.1f}"
    limit = "" if one.limit is None else _limit(one.limit, one.limit_unit)
    return title(one.key[0]), one.key[1], before, after, value, limit


def _limit(value: float, unit: str) -> str:
    return quantity(Value(value, float("nan"), unit))


def not_found(unseen: Sequence[Unseen], ranking: Sequence[Ranked]) -> str:
    """What was not found with its detection limits, and what the record cannot show."""
    clear = {r.key: r for r in ranking if r.after is not None and r.after > LIMIT_SD}
    seen = [u for u in unseen if u.visible and u.detection_limit is not None]
    hidden = [u for u in unseen if u not in seen]
    rows = (
        (
            title(u.effect),
            u.where,
            _limit(u.detection_limit or 0.0, u.unit),
            u.reason or _why_not(clear.get((u.effect, u.where))),
        )
        for u in seen
    )
    blind = ((title(u.effect), u.where, u.reason) for u in hidden)
    return section(
        "Looked for and not found",
        f"<p>An effect of the size below would have stood out by {LIMIT_SD:g} standard deviations "
        "of this record.</p>",
        table(("effect", "where", "smallest size that would have shown", "remark"), rows),
        "<h3>What this record cannot show</h3>" + table(("effect", "where", "why"), blind)
        if hidden
        else "",
    )


def _why_not(clear: Ranked | None) -> str:
    """A remark on what stands out and was not added all the same."""
    if clear is None:
        return ""
    if not clear.is_possible:
        return f"{clear.after:.0f} sd, with a sign or size that is not possible"
    return f"{clear.after:.0f} sd, but immaterial or no explanation of what is left"


def negligible(small: Sequence[Small]) -> str:
    """Effects that are present and change next to nothing."""
    rows = [
        (title(s.effect), s.where, f"{100 * s.heldout_share_of_rms_flow:.2g} % of the rms flow")
        for s in small
    ]
    head = ("effect", "where", "what it changes")
    return section("Present but negligible", table(head, rows) if rows else "<p>None.</p>")


def history(changes: Sequence[Change]) -> str:
    """What was added and dropped, and what it brought; nothing where there is no history."""
    if not changes:
        return ""
    alive = {change.number for change in standing(changes)}
    rows = [
        (
            str(c.number),
            c.date[:16].replace("T", " "),
            f"{c.change} {title(c.effect)} ({c.where})"
            + (", taken back" if c.change != UNDO and c.number not in alive else ""),
            _fall(c, "identification_pct"),
            _fall(c, "heldout_pct"),
            f"{c.errors['noise_floor_pct']:.2f} %" if c.errors.get("noise_floor_pct") else "",
            c.reason,
        )
        for c in changes
    ]
    head = ("", "date", "change", "identification", "held out", "floor", "reason")
    return section("History of the model: errors in % of the rms flow", table(head, rows))


def _fall(change: Change, part: str) -> str:
    pair = change.errors.get(part, {})
    return f"{pair['before']:.2f} → {pair['after']:.2f}" if len(pair) == 2 else ""
