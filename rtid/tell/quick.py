"""What a file tells without a project file, as an engineer reads it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from rtid.compare.dead_band import DeadBand
from rtid.effects import correcting
from rtid.effects.page import DEAD_VOLUME
from rtid.study.quick import Quick
from rtid.study.quick_rate import QuickRate
from rtid.tell.diagnosed import sentences
from rtid.tell.records import record_lines
from rtid.trace.quick_data import BAD, FAIR, GOOD
from rtid.units import scale_of

MARKS = {GOOD: "+", FAIR: "~", BAD: "-"}
ANSWERS = {
    GOOD: "Is this data good enough?  Yes.",
    FAIR: "Is this data good enough?  With reservations.",
    BAD: "Is this data good enough?  No.",
}
SIZES = ("--bore", "--rod", "--stroke", "--dead-volume", "--safe-band", "--lag", "--supply")


def lines(quick: Quick, saved: Path | None = None) -> Iterator[str]:
    """Everything, line by line: roles, assumptions, the data, the verdict, the next command.

    saved: where its project was written.
    """
    yield f"{quick.path.name}, without a project file.  Taken as:"
    for role, candidate in quick.roles.items():
        guessed = ", unit guessed from its range" if candidate.guessed_unit else ""
        yield f"  {role:9} {candidate.full_name} [{candidate.unit}{guessed}]"
    if quick.unused:
        yield f"Not used: {', '.join(quick.unused)}"
    nu, nd = len(quick.machine.u_grid) - 1, len(quick.machine.dp_grid_pa) - 1
    yield f"Maps on {nu} x {nd} blocks a valve, over what the record reaches."
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
    if saved is not None:
        says = "takes it, and says the same"
        if quick.records:
            says = f"learns from all {len(quick.records)} records; above stands what the first says"
        yield f"wrote {saved}: every other command {says}."
        yield f"Next: {quick.after(saved)}"
        return
    yield f"Next: {quick.next_command}"
    yield f"  writes the project with what is assumed; {' '.join(SIZES)} make it yours."


def rate_lines(quick: QuickRate, saved: Path | None = None) -> Iterator[str]:
    """Of a table without pressures: the pair, its neutral, band and gains, the verdict."""
    pair, u = quick.pair, quick.pair.command
    yield f"{quick.path.name}, without a project file: {pair.kind}, {pair.equation}."
    for role, candidate in pair.roles.items():
        guessed = ", unit guessed from its range" if candidate.guessed_unit else ""
        yield f"  {role:9} {candidate.full_name} [{candidate.unit}{guessed}]"
    for other in quick.others:
        yield f"There is another pair: {other.options}"
    if quick.unused:
        yield f"Not used: {', '.join(quick.unused)}"
    yield ""
    if pair.pressed:
        for band in quick.bands.values():
            yield f"The area is {band.gain_above:.4g} {quick.unit}/{quick.command_unit}."
    elif pair.is_measured:
        yield from _range_lines(quick)
    elif pair.drive:
        yield from _turn_lines(quick)
    else:
        yield f"The neutral of the command is {pair.neutral:.6g} {u.unit}: there x stands most."
        if len(quick.records) > 1:
            each = ", ".join(f"{neutral:.6g}" for neutral in quick.neutrals)
            yield f"In each record it is found anew: {each} {u.unit}."
        for name, band in quick.bands.items():
            yield from band_lines(name, band, quick.unit, quick.command_unit)
    yield ""
    yield f"Verdict: {quick.diagnosis.verdict}."
    for sentence in sentences(quick.diagnosis):
        yield f"  {sentence}"
    yield from record_lines(quick.errors)
    if not quick.is_enough:
        yield from _more_lines(quick)
    yield ""
    if saved is not None:
        yield f"wrote {saved}"
        yield f"Next: rtid replay {quick.path} -p {saved}"
        return
    yield f"Next: {quick.next_command}"
    yield "  writes the project with what was found."


def _more_lines(quick: QuickRate) -> Iterator[str]:
    """What a verdict takes that the record has not, and the command that goes on."""
    has, needs = quick.rows
    if has < needs:
        yield f"  {has} rows of it teach, and a verdict takes {needs} at least."
    yield "  Record more motion; several records of one machine make one fit:"
    yield f"  {quick.with_more}"


def _turn_lines(quick: QuickRate) -> Iterator[str]:
    """What a turn of a pump moves, beside all that was found."""
    scale = scale_of(quick.unit.removesuffix("/s"))
    turn = math.tau * scale.factor
    for band in quick.bands.values():
        above, below = (turn * gain for gain in (band.gain_above, band.gain_below))
        yield f"A turn of the pump moves x by {above:.4g} {scale.name}, back by {below:.4g}."


def _range_lines(quick: QuickRate) -> Iterator[str]:
    """What the map of a measured rate gives at both ends of what is known of it."""
    scale = scale_of(quick.unit)
    for name, (low, high, first, last) in quick.ranges.items():
        yield (
            f"Map {name} is known from {low:.4g} to {high:.4g} {quick.command_unit}: it gives "
            f"{scale.factor * first:.4g} and {scale.factor * last:.4g} {scale.name} there."
        )


def band_lines(name: str, band: DeadBand, unit: str, command_unit: str) -> Iterator[str]:
    """Dead band and gains of one map in words; unit: SI, of its flow."""
    if not math.isfinite(band.low):
        yield f"Map {name} is not known on both sides of the neutral: command both ways."
        return
    scale = scale_of(unit)
    gains = [scale.factor * gain for gain in (band.gain_below, band.gain_above)]
    yield (
        f"Map {name} passes next to nothing from {band.low:.3g} to {band.high:+.3g} {command_unit} "
        f"about it; beyond, it gives {gains[0]:.3g} and {gains[1]:.3g} {scale.name} per "
        f"{command_unit}, below and above."
    )


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
    declared = dict(zip("ab", quick.machine.dead_volumes_m3, strict=True))
    volumes = [
        f"{1e3 * (declared[a.where] + a.parameters['volume'].value):.2f} L at {a.where}"
        for a in diagnosis.added
    ]
    if volumes and quick.is_enough:
        yield f"  Dead volumes, as fitted: {' and '.join(volumes)}."
