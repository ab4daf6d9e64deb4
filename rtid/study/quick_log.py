"""What a log makes of a command: a row that is written late, which is nothing of the machine.

A command that is written a row after it acted is a delay of less than nothing: what is left of the
spools' lag ends at nothing, and no cause of the catalogue is as early.  It is asked for where less
than a row of lag is left: a longer one has room for the row.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.diagnose.fit import Fit
from rtid.diagnose.report import Diagnosis
from rtid.effects.laws.timing import TIMINGS, delayed
from rtid.study.quick_command import At, Reading, is_taken, said_of, wins
from rtid.study.quick_machine import Assumption, MachineSizes
from rtid.study.study import Study


def late_by_a_row(machine: MachineSizes, step_s: float) -> MachineSizes:
    """The machine with a log of rows step_s, s, apart that writes its command one late."""
    assumption = Assumption(
        f"the log writes the command a row late, {1e3 * step_s:.3g} ms",
        "the valves answer before they are told (late_rows of u)",
    )
    assumptions = *machine.assumptions, assumption
    return replace(machine, command_late_rows=1, assumptions=assumptions)


def written_late(first: Reading, at: At) -> Reading:
    """The record with its command a row earlier, where that makes it likelier.

    No more than a row: each is asked by a diagnosis of its own.
    """
    step_s = 1e-6 * float(np.median(np.diff(first.study.read.samples.t_us)))
    if first.said.lag_s > step_s:
        return first
    machine = late_by_a_row(first.machine, step_s)
    study = at(machine)
    if not is_likelier(study, first.study):
        return first
    said = said_of(study)
    is_better = is_taken(said, first.said) and not is_between_rows(said)
    return Reading(study, machine, said) if is_better else first


def is_between_rows(said: Diagnosis) -> bool:
    """Whether a command that was put a row earlier is found to be late, by a part of a row.

    Then the log has not written it late: it is a sample of a faster one, half a step ahead of what
    is held.  A healthy machine at 50 rows a second was told of a row and a delay of 11 ms.
    """
    names = {name for f in said.found for name in (f.effect, *f.cannot_be_told_from)}
    return any(timing.effect in names for timing in TIMINGS if timing.apply is delayed)


def is_likelier(study: Study, first: Study) -> bool:
    """Whether another reading leaves less by itself than the first with all it found, or wins."""
    last, bare = first.diagnosed.result.last, study.fitted
    if last.revision.n_causes > bare.revision.n_causes and _excess(bare) < _excess(last):
        return True
    won, least = wins(study, first)
    return won > least


def _excess(of: Fit) -> float:
    """What it leaves of its rows beyond their noise, weighed for exactly what it has found."""
    return of.settled_chi2 - of.regression.dof
