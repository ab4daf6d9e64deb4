"""What a diagnosis says in one or two sentences, and what to do next."""

from __future__ import annotations

from rtid.diagnose.report import Diagnosis, Effect
from rtid.diagnosed_text import percent, title
from rtid.report_sizes import size


def judged(found: Diagnosis) -> str:
    """Which part of the record the errors are of."""
    return "held-out error" if found.held_out_judged else "error on the motion it was taught by"


def said(found: Diagnosis) -> str:
    """The verdict and the next step."""
    left = percent(found, found.heldout_residual_before_m3s)
    floor = f"the sensors' floor is {percent(found, found.noise_floor_m3s)}"
    match found.verdict:
        case "insufficient_data":
            return (
                "Nothing can be said about what is missing. Next: record a minute or more in which "
                "every valve opens over its range, under changing load or supply pressure; Why "
                "says which motion would tell more."
            )
        case "matches":
            here = "With what was added, the" if found.added else "The"
            more = "what remains beyond it is immaterial" if found.something_remains else (
                "no model could be much better")  # fmt: skip
            return f"{here} {judged(found)} is {left} of the rms flow; {floor}: {more}."
        case "unknown":
            return (
                f"No known effect explains the {judged(found)} of {left}; {floor}. Next: Where "
                "shows which signals it follows; an effect of your own goes into the project file "
                "as a formula."
            )
    return _found(found, found.found[0], floor)


def _found(found: Diagnosis, first: Effect, floor: str) -> str:
    sizes = list(first.parameters.values())
    big = f", {size(sizes[0])} (95 %)" if len(sizes) == 1 else ""
    before = percent(found, first.heldout_residual_before_m3s)
    after = percent(found, first.heldout_residual_after_m3s)
    words = (
        f"{title(first.effect)} at {first.where}{big}. Adding it lowers the {judged(found)} from "
        f"{before} to {after}; {floor}."
    )
    if first.cannot_be_told_from:
        others = ", ".join(
            title(name.partition(" (")[0]).lower() for name in first.cannot_be_told_from
        )
        words += f" This record cannot tell it from {others}: the choice is yours."
    rest = len(found.found) - 1
    return words + (f" {rest} more after it." if rest else "")
