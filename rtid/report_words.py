"""Words of report and page: the verdicts as headings, and what becomes of words in HTML.

VERDICTS: a kind, for the colour, and the heading.
"""

from __future__ import annotations

from html import escape

VERDICTS = {
    "matches": ("good", "The model matches"),
    "missing": ("found", "Something is missing, and has a name"),
    "ambiguous": ("open", "Something is missing: one of a set"),
    "unknown": ("open", "Something unknown is missing"),
    "insufficient_data": ("open", "Too little motion to tell"),
}


def text(words: str) -> str:
    """Words as HTML."""
    return escape(words.replace("+-", "±"))
