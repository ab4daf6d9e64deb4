"""The zero of a pressure sensor, put right in a study: its samples change, not its model.

p = p_shown - b,   b as the diagnosis has found it where open valves join sensors at rest
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from rtid.diagnose.consequence import BEND
from rtid.diagnose.extend import Extension, RefusedError
from rtid.diagnose.report import Value
from rtid.diagnose.zeros import Zero
from rtid.effects.page import effect as page_of
from rtid.units import with_unit

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rtid.project.added import AddedSection
    from rtid.study.study import Study


def shifted(study: Study, signal: str, by_pa: float, sections: tuple[AddedSection, ...]) -> Study:
    """The same record with so much added to what a sensor shows, in memory; the file stays.

    sections: what the project has added then.
    """
    samples, machine = study.read.samples, study.machine
    values = samples.values.copy()
    values[:, samples.names.index(signal)] += by_pa
    project = replace(study.project, sections=replace(study.project.sections, added=sections))
    read = replace(study.read, samples=replace(samples, values=values))
    same = {
        name: vars(study)[name] for name in ("paths", "path", "progress", "bus_speed", "records")
    }
    other = object.__new__(type(study))
    vars(other).update(same, project=project, machine=machine, read=read, _place=None)
    return other


def tried(study: Study, effect: str, where: str) -> Extension:
    """The model with the zero of one sensor put right, and what speaks against that.

    Raises RefusedError where the record does not tell it.
    """
    zero = _told(study, effect, where)
    size = page_of(effect).size
    without = shifted(study, zero.signal, -zero.apart_pa, study.project.sections.added)
    return Extension(
        key=(effect, zero.signal),
        gain=(zero.apart_pa / zero.std_pa) ** 2,
        before=study.standing,
        after=without.standing,
        against=tuple(_against(zero)),
        better="",
        sizes={size.name: Value(zero.apart_pa, zero.std_pa, size.unit)},
    )


def _told(study: Study, effect: str, where: str) -> Zero:
    """The zero of that sensor, or the one that matters most where none is named."""
    known = [z for z in study.diagnosis().zeros if where in ("", z.signal)]
    if not known:
        raise RefusedError(
            f"this record does not tell the zero of {where or 'any pressure sensor'}: no open "
            "valve joins it to another at rest",
            "drive against both stops, the valves open, for some seconds each: "
            f"`rtid effects {effect}`",
        )
    return max(known, key=lambda z: (z.matters, abs(z.apart_pa) / z.std_pa))


def _against(zero: Zero) -> Iterator[str]:
    size = with_unit(zero.apart_pa, "Pa", zero.std_pa)
    if not zero.is_off:
        yield f"its zero is not off: {size} against {zero.against}"
    elif not zero.is_confirmed:
        yield f"{size} apart, but nothing says that {zero.signal} is wrong and not {zero.against}"
    elif not zero.matters:
        yield f"{size} bends no map by {100 * BEND:g} % of its largest flow"
