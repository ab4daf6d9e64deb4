"""What the pressures of a record count from: nothing, or the air, as most sensors of a machine do.

"bar" says neither, and is read as absolute.  Air in the oil alone tells (`rtid.diagnose.air_zero`),
so it is asked where a record does not match and air would explain most of that.  Where something
else is missing too, neither reading may be likelier by more than chance: then one that has a name
for the air stands in place of one that has none.
"""

from __future__ import annotations

from dataclasses import replace

from rtid.diagnose.air_zero import wins_from_air
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import AMBIGUOUS, MISSING
from rtid.effects import catalogue
from rtid.effects.page import PRESSURE_ZERO
from rtid.project import Project
from rtid.study.quick_command import At, Reading, is_taken, said_of
from rtid.study.quick_machine import Assumption, MachineSizes
from rtid.units import find_unit


def from_air(first: Reading, at: At) -> Reading:
    """The record with its pressures counted from the air, where air in its oil says so."""
    if says_from_what(first.study.project):
        return first
    won, least = wins_from_air(first.study.fitted)
    if not won > (least if names_air(first.said) else -least):
        return not_told(first) if won > -least else first
    machine = counted_from_air(first.machine)
    study = at(machine)
    said = said_of(study)
    is_better = is_taken(said, first.said) and names_air(said)
    return Reading(study, machine, said) if is_better else first


def says_from_what(project: Project) -> bool:
    """Whether a pressure of a project is said to count from the air."""
    known = (find_unit(s.unit or "") for s in project.sections.signals.values())
    return any(unit.dimension == "pressure" and unit.offset for unit in known if unit)


def names_air(said: Diagnosis) -> bool:
    """Whether air in the oil is named, or one of those that cannot be told from what is."""
    names = {name for f in said.found for name, _ in ((f.effect, f.where), *f.alike)}
    airs = {name for name, page in catalogue().items() if PRESSURE_ZERO in page.stands_on}
    return said.verdict in (MISSING, AMBIGUOUS) and bool(airs & names)


def counted_from_air(machine: MachineSizes) -> MachineSizes:
    """The machine with pressures that count from the air."""
    assumption = Assumption(
        "the pressures count from the air, and not from nothing, as air in the oil has it (offset)",
        "the share and the exponent of the air are off",
    )
    assumptions = *machine.assumptions, assumption
    return replace(machine, pressures_from_air=True, assumptions=assumptions)


def not_told(first: Reading) -> Reading:
    """The reading, with what is assumed where either explains the record as well."""
    assumption = Assumption(
        "the pressures are absolute; counted from the air, as of barg, they explain the record as "
        "well",
        "the share and the exponent of the air are off",
    )
    assumptions = *first.machine.assumptions, assumption
    return replace(first, machine=replace(first.machine, assumptions=assumptions))
