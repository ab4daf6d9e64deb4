"""Whether the command of a record is held from sample to sample, or a sample of a faster one.

A log of 50 Hz beside a controller of 1 kHz does not say what the valves were told in between: every
clean machine left 2 to 40 times the noise's variance there, and was `unknown`.  Where a record does
not match with its command held, it is asked whether it is likelier with the command on a line
between its samples, nothing being integrated across a jump.  Then a share of what is unknown of it
(`rtid.trace.between`) is its noise: the likeliest.  What wins no more than by chance, or leaves
nine tenths of a misfit, tells of neither: then the command is held, as it was read first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from firmware_bridge.samples import Samples
from rtid.diagnose.admission import LEAST_SHARE
from rtid.diagnose.fit import Fit, fit
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.revision import Revision
from rtid.diagnose.trials import TIE
from rtid.diagnose.verdict import AMBIGUOUS, MATCHES, MISSING
from rtid.errors import RtidError
from rtid.study.quick_machine import Assumption, MachineSizes
from rtid.study.study import Study
from rtid.trace.between import FASTEST_S, unknown_between

TINY = 1e-300
SHARES = 0.0, 0.5, 1.0  # of what is unknown between its samples, that are tried as its noise
At = Callable[[MachineSizes], Study]  # the study of a file by the project of this machine


@dataclass(frozen=True)
class Reading:
    """A machine with the way in which the command of its log is read, and what is said of it."""

    study: Study
    machine: MachineSizes
    said: Diagnosis


def said_of(study: Study) -> Diagnosis:
    """The diagnosis; RtidError for data that its numerics cannot bear: they are anybody's."""
    try:
        return study.diagnosis()
    except np.linalg.LinAlgError as error:
        raise RtidError(
            f"{study.path}: the fit fails on this data ({error})",
            "record more motion; if it looks sound to you, please report it with the file",
        ) from error


def on_a_line(first: Reading, at: At) -> Reading:
    """The record with its command on a line between its samples, where it is likelier so."""
    looser = less_known(first.machine, first.study.read.samples)
    tried = [Reading(at(machine), machine, first.said) for machine in looser]
    if not tried:
        return first
    won, least = wins(tried[0].study, first.study)
    if not won > least:
        told = not_told(first.machine, looser[0].command_step_s)
        return replace(first, machine=told) if won > -least else first
    best = min(tried, key=lambda reading: unlikeliness(reading.study.fitted))
    best = replace(best, said=said_of(best.study))
    return best if is_taken(best.said, first.said) else first


def less_known(machine: MachineSizes, samples: Samples) -> list[MachineSizes]:
    """The machine with a command that is a sample of a faster one: known on a line, and less.

    samples: of a table, with the command as it is written; none where they tell all of it.
    """
    sd, step_s = unknown_between(np.multiply(1e-6, samples.t_us), samples.column("u"))
    if step_s < FASTEST_S or not sd:
        return []
    assumption = Assumption(
        f"the command is a sample of a faster one, every {1e3 * step_s:.3g} ms",
        "a controller that changes it at these alone is judged too mildly (hold, noise of u)",
    )
    assumptions = *machine.assumptions, assumption
    line = replace(machine, command_hold="linear", command_step_s=step_s, assumptions=assumptions)
    return [replace(line, command_noise=share * sd) for share in SHARES]


def rows_apart_s(samples: Samples) -> float:
    """Time between the samples of a table where its controller may be faster; else 0."""
    _, step_s = unknown_between(np.multiply(1e-6, samples.t_us), samples.column("u"))
    return step_s if step_s >= FASTEST_S else 0.0


def hidden_s(samples: Samples, is_on_a_line: bool, tolerance_s: float) -> float:
    """What the rows of a table hide of the spools' lag, s, one deviation; tolerance_s: declared.

    A controller as fast as the log holds its command; of a much faster one it is on a line, half a
    step ahead of what is held, and the lag as much longer: by anything from nothing to half a step,
    the root of whose mean square is step / sqrt(12).  0.136 +- 0.032 ms were told of 1.610, at
    4 ms.  No more of it is open than what was declared.

    On a line each change is spread over its step, in which it has jumped at any instant, so that n
    jumps alike tell of a lag to step / sqrt(12 n): 3.412 +- 0.005 ms were told of 3.112, at 5 ms.
    """
    open_s = rows_apart_s(samples) / np.sqrt(12.0)
    if not is_on_a_line:
        return float(min(open_s, tolerance_s))
    told = np.diff(samples.column("u")) ** 2  # by how much each tells of the lag
    return float(open_s * np.linalg.norm(told) / max(told.sum(), TINY))


def between_rows(said: Diagnosis, hidden_s: float) -> Diagnosis:
    """What is said, with what the rows hide of the lag, s, in its interval."""
    return replace(said, lag_sd_s=float(np.hypot(said.lag_sd_s, hidden_s)))


def is_taken(line: Diagnosis, first: Diagnosis) -> bool:
    """Whether what is said with the command on a line stands in place of the first.

    What was named is not given up for a verdict that says less, nor for one that names more, or
    leaves more than noise; nor is what has no name either way for more of it: 8 times the noise,
    of a controller as slow as its log, were 49, with moduli of 240 and 150 MPa, of 1590.
    """
    named = MISSING, AMBIGUOUS
    if line.verdict == MATCHES:
        return True
    leaves_less = line.rho_after <= max(1.0, first.rho_after)
    if first.verdict not in named:
        return line.verdict in named or leaves_less
    is_simpler = len(line.found) <= len(first.found)
    return line.verdict in named and is_simpler and leaves_less


def unlikeliness(fit: Fit) -> float:
    """-2 log likelihood of a fit, per row of it."""
    return float(fit.held.sse + fit.regression.log_noise) / max(1, fit.regression.rows)


def wins(line: Study, first: Study) -> tuple[float, float]:
    """What chi2 falls by with the command on a line, and by how much it must to be believed.

    On the same rows, each fitted to its end and weighed for what it has found: a fit that takes an
    oil for 9 GPa has less of the pressures' noise to answer for, and a line that is half a sample
    late is as good as a command that is held.  Either is asked beside what was found with the
    command as it was first: what is missing in both would tell for the one whose lag, or whose
    oil, stands in for more of it.  That is begun for either where it ended for either: a pump of
    slow descent was 108 of chi2 from its end, and the line had won.
    """
    found = first.diagnosed.result.last
    fit_, known = _beside(line.fitted, found.revision), first.taught
    chunk, column = fit_.chunk.copy(), 2 + line.machine.column("u")
    chunk[:, column] = known[np.searchsorted(known[:, 0], chunk[:, 0]), column]
    weights = replace(fit_.weights, lag_s=found.weights.lag_s)
    starts = {replace(revision, sizes=()) for revision in (found.revision, fit_.revision)}
    ends = [fit(fit_.declared, chunk, weights, start, bank=False) for start in starts]
    held = min(ends, key=lambda end: end.excess)
    stiffest = 1.0 / max(fit_.declared.beta_bounds_pa)
    if held.compliance.min() < stiffest <= fit_.compliance.min():
        return np.inf, 0.0  # beside a command that is held no oil can be so stiff: it is none
    chance = TIE * max(1.0, fit_.rho)
    misfit = held.settled_chi2 - held.regression.dof
    return held.settled_chi2 - fit_.settled_chi2, max(chance, LEAST_SHARE * misfit)


def _beside(line: Fit, revision: Revision) -> Fit:
    """A fit with what was found beside another reading of the command."""
    if not revision.n_causes:
        return line
    weights, sizes = line.weights, replace(revision, sizes=())
    return fit(line.declared, line.chunk, weights, sizes, line, bank=False)


def not_told(machine: MachineSizes, step_s: float) -> MachineSizes:
    """The machine, with what is assumed where neither reading is likelier than by chance."""
    assumption = Assumption(
        f"the command is held over its {1e3 * step_s:.3g} ms; on a line between its samples it "
        "explains the record as well",
        f"of a line the spools lag {500.0 * step_s:.3g} ms more (hold of u)",
    )
    return replace(machine, assumptions=(*machine.assumptions, assumption))
