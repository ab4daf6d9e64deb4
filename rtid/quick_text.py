"""What a file tells without a project file, as an engineer reads it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from rtid.diagnosed_text import sentences
from rtid.quick import Quick
from rtid.quick_data import BAD, FAIR, GOOD

MARKS = {GOOD: "+", FAIR: "~", BAD: "-"}
ANSWERS = {
    GOOD: "Is this data good enough?  Yes.",
    FAIR: "Is this data good enough?  With reservations.",
    BAD: "Is this data good enough?  No.",
}
NOT_JUDGED = ("extra_dead_volume", "hose_compliance")  # where the dead volume is fitted
FILL_IN = "[geometry] stroke, [chambers.*] area and dead volume, safe_band, rated flow, spool lag"


def lines(found: Quick) -> Iterator[str]:
    """Everything, line by line: roles, assumptions, the data, the verdict, the next command."""
    yield f"{found.path.name}, without a project file.  Taken as:"
    for role, one in found.roles.items():
        guessed = ", unit guessed from its range" if one.guessed_unit else ""
        yield f"  {role:9} {f'{one.message}.{one.name}'.lstrip('.')} [{one.unit}{guessed}]"
    yield ""
    yield "Assumed, and what is wrong if it is not so:"
    for assumption in found.assumptions:
        yield f"  * {assumption.what}: else {assumption.if_wrong}."
    yield ""
    yield ANSWERS[found.level]
    for point in found.points:
        yield f"  {MARKS[point.level]} {point.text}"
        if point.remedy and point.level != GOOD:
            yield f"      -> {point.remedy}"
    yield ""
    yield from _verdict(found)
    yield ""
    yield f"Next: {found.next_command}"
    yield f"  fill in {FILL_IN}; then"
    yield f"  rtid check machine.toml {found.path}  and  rtid diagnose {found.path} -p machine.toml"


def _verdict(found: Quick) -> Iterator[str]:
    if found.diagnosis is None:
        yield "No verdict: mend what is marked with - first."
        return
    told = found.diagnosis
    yield f"Verdict: {told.verdict}."
    advice = tuple(a for a in told.advice if not a.startswith(NOT_JUDGED) or not told.added)
    plain = replace(told, added=(), advice=advice)
    for sentence in (*sentences(plain), *found.cautions):
        yield f"  {sentence}"
    volumes = [
        f"{1e3 * (found.dead_volume_m3 + a.parameters['volume'].value):.2f} L at {a.where}"
        for a in told.added
    ]
    if volumes and found.is_enough:
        yield f"  Dead volumes, as fitted: {' and '.join(volumes)}."
