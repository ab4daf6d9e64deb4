"""What a log makes of a command: rows that are written late, which is nothing of the machine.

A command that is written n rows after it acted is a delay of less than nothing: what is left of the
spools' lag ends at nothing, and no cause of the catalogue is as early.  It is asked for where less
than a row of lag is left: a longer one has room for the row.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtid.diagnose.fit import Fit
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import MATCHES
from rtid.effects.laws.timing import TIMINGS, delayed
from rtid.study.quick_command import At, Reading, is_taken, said_of, wins
from rtid.study.quick_machine import Assumption, MachineSizes
from rtid.study.study import Study

MOST_ROWS = 1  # that a log is asked to write a command late: each asks for a diagnosis of its own


def late_by(machine: MachineSizes, rows: int, step_s: float) -> MachineSizes:
    """The machine with a log that writes its command so many rows late, of step_s, s."""
    a_row = "a row" if rows == 1 else f"{rows} rows"
    assumption = Assumption(
        f"the log writes the command {a_row} late, {1e3 * rows * step_s:.3g} ms",
        "the valves answer before they are told (late_rows of u)",
    )
    assumptions = *machine.assumptions, assumption
    return replace(machine, command_late_rows=rows, assumptions=assumptions)


def written_late(first: Reading, at: At) -> Reading:
    """The record with its command as many rows earlier as make it likelier."""
    samples, best = first.study.read.samples, first
    step_s = 1e-6 * float(np.median(np.diff(samples.t_us)))
    for rows in range(1, MOST_ROWS + 1):
        if best.said.verdict == MATCHES or best.said.lag_s > step_s:
            break
        machine = late_by(first.machine, rows, step_s)
        study = at(machine)
        if not is_likelier(study, best.study):
            break
        said = said_of(study)
        if is_between_rows(said) or not is_taken(said, best.said):
            break
        best = Reading(study, machine, said)
    return best


def is_between_rows(said: Diagnosis) -> bool:
    """Whether a command that was put rows earlier is found to be late, by a part of a row.

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
