"""Names of columns and signals that carry their unit: "p_a [MPa]", "p_a (MPa)", "p_a / MPa", x_mm.

What counts as a unit is told by the caller; here is only where it may stand.
"""

from __future__ import annotations

import re
from collections.abc import Callable

IsUnit = Callable[[str, str], bool]  # whether a text is a unit behind this stem
_BRACKETS = re.compile(  # which may hold some of their own: [bar(a)]
    r"^(?P<stem>.*?)\s*[\[(](?P<unit>(?:[^\[\]()]|[\[(][^\[\]()]*[\])])*)[\])]\s*$"
)
_QUOTIENT = re.compile(r"^(?P<stem>[^/]*?)\s*/\s*\(?(?P<unit>[^()]+)\)?\s*$")
_WORDS = re.compile(r"[_\s.,]+")


def split_brackets(title: str) -> tuple[str, str]:
    """Name and unit of "p_a [MPa]" or "p_a (MPa)"; the unit is empty where no brackets end it."""
    match = _BRACKETS.match(title.strip())
    return (match["stem"].rstrip(" /"), match["unit"].strip()) if match else (title.strip(), "")


def split_unit(title: str, is_unit: IsUnit) -> tuple[str, str]:
    """Name and unit, in brackets, behind a stroke, or as the last word or the last two (cm_s).

    Brackets need no known unit: nothing else ends a name in them.  The unit is empty if there is
    none.
    """
    stem, unit = split_brackets(title)
    if unit and stem:
        return stem, unit
    quotient = _QUOTIENT.match(title.strip())
    if quotient and is_unit(quotient["unit"], quotient["stem"]):
        return quotient["stem"], quotient["unit"]
    words = list(_WORDS.finditer(title.strip()))
    for n in (2, 1):
        if len(words) < n:
            continue
        stem = title.strip()[: words[-n].start()]
        unit = "/".join(_WORDS.split(title.strip()[words[-n].end() :]))
        if stem and is_unit(unit, stem):
            return stem, unit
    return title.strip(), ""
