"""What a file tells without a project file, as an engineer reads it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from rtid.effects import correcting
from rtid.study.quick import Quick
from rtid.study.quick_project import DEAD_VOLUME
from rtid.tell.diagnosed import sentences
from rtid.trace.quick_data import BAD, FAIR, GOOD

MARKS = {GOOD: "+", FAIR: "~", BAD: "-"}
ANSWERS = {
    GOOD: "Is this data good enough?  Yes.",
    FAIR: "Is this data good enough?  With reservations.",
    BAD: "Is this data good enough?  No.",
}
FILL_IN = "[geometry] stroke, [chambers.*] area and dead volume, safe_band, rated flow, spool lag"


def lines(quick: Quick) -> Iterator[str]:
    """Everything, line by line: roles, assumptions, the data, the verdict, the next command."""
    yield f"{quick.path.name}, without a project file.  Taken as:"
    for role, candidate in quick.roles.items():
        guessed = ", unit guessed from its range" if candidate.guessed_unit else ""
        yield f"  {role:9} {candidate.full_name} [{candidate.unit}{guessed}]"
    if quick.unused:
        yield f"Not used: {', '.join(quick.unused)}"
    yield ""
    yield "Assumed, and what is wrong if it is not so:"
    for assumption in quick.assumptions:
        yield f"  * {assumption.what}: else {assumption.if_wrong}."
    yield ""
    yield ANSWERS[quick.level]
    for point in quick.points:
        yield f"  {MARKS[point.level]} {point.text}"
        if point.remedy and point.level != GOOD:
            yield f"      -> {point.remedy}"
    yield ""
    yield from _verdict(quick)
    yield ""
    yield f"Next: {quick.next_command}"
    yield f"  fill in {FILL_IN}; then"
    yield f"  rtid check machine.toml {quick.path}  and  rtid diagnose {quick.path} -p machine.toml"


def _verdict(quick: Quick) -> Iterator[str]:
    if quick.diagnosis is None:
        yield "No verdict: mend what is marked with - first."
        return
    diagnosis = quick.diagnosis
    yield f"Verdict: {diagnosis.verdict}."
    fitted = tuple(page.name for page in correcting(DEAD_VOLUME)) if diagnosis.added else ()
    advice = tuple(a for a in diagnosis.advice if not a.startswith(fitted))
    plain = replace(diagnosis, added=(), advice=advice)
    for sentence in (*sentences(plain), *quick.cautions):
        yield f"  {sentence}"
    volumes = [
        f"{1e3 * (quick.dead_volume_m3 + a.parameters['volume'].value):.2f} L at {a.where}"
        for a in diagnosis.added
    ]
    if volumes and quick.is_enough:
        yield f"  Dead volumes, as fitted: {' and '.join(volumes)}."
