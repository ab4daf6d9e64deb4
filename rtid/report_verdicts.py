"""The verdicts as headings: a kind for the colour, and words."""

VERDICTS = {
    "matches": ("good", "The model matches"),
    "missing": ("found", "Something is missing, and has a name"),
    "ambiguous": ("open", "Something is missing: one of a set"),
    "unknown": ("open", "Something unknown is missing"),
    "insufficient_data": ("open", "Too little motion to tell"),
}
