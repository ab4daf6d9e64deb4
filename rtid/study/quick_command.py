"""Whether the command of a record is held from sample to sample, or a sample of a faster one.

A log of 50 Hz beside a controller of 1 kHz does not say what the valves were told in between: every
clean machine left 2 to 40 times the noise's variance there, and was `unknown`.  Where a record does
not match with its command held, it is asked whether it is likelier with the command on a line
between its samples, nothing being integrated across a jump.  Then a share of what is unknown of it
(`rtid.trace.between`) is its noise: the likeliest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from firmware_bridge.samples import Samples
from rtid.diagnose.fit import Fit, one_pass
from rtid.diagnose.report import Diagnosis
from rtid.diagnose.verdict import AMBIGUOUS, MATCHES, MISSING
from rtid.study.quick_machine import Assumption, MachineSizes
from rtid.study.study import Study
from rtid.trace.between import FASTEST_S, unknown_between

SHARES = 0.0, 0.5, 1.0  # of what is unknown between its samples, that are tried as its noise


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


def is_taken(line: Diagnosis, first: Diagnosis) -> bool:
    """Whether what is said with the command on a line stands in place of the first.

    What was named is not given up for a verdict that says less, nor for one that names more, or
    leaves more than noise.
    """
    named = MISSING, AMBIGUOUS
    if first.verdict not in named or line.verdict == MATCHES:
        return True
    is_simpler = len(line.found) <= len(first.found)
    leaves_less = line.rho_after <= max(1.0, first.rho_after)
    return line.verdict in named and is_simpler and leaves_less


def unlikeliness(fit: Fit) -> float:
    """-2 log likelihood of a fit, per row of it."""
    return float(fit.held.sse + fit.regression.log_noise) / max(1, fit.regression.rows)


def is_likelier(line: Study, first: Study) -> bool:
    """Whether a record is likelier with its command on a line than as it was first, held.

    On the same rows, each with its own lag and weighed for what it has found: a fit that takes an
    oil for 9 GPa has less of the pressures' noise to answer for, and a line that is half a sample
    late is as good as a command that is held.  One beside which no oil can be so stiff is none.
    Either is asked without what is missing: what is hidden in both tells of neither.
    """
    fit, known = line.fitted, first.taught
    chunk, column = fit.chunk.copy(), 2 + line.machine.column("u")
    chunk[:, column] = known[np.searchsorted(known[:, 0], chunk[:, 0]), column]
    weights = replace(fit.weights, lag_s=first.fitted.weights.lag_s)
    held = one_pass(fit.declared, chunk, weights, fit.revision, None, False, thorough=False)
    stiffest = 1.0 / max(fit.declared.beta_bounds_pa)
    if held.compliance.min() < stiffest <= fit.compliance.min():
        return True
    return fit.settled_chi2 < held.settled_chi2
