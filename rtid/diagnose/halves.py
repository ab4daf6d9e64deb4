"""Whether an effect has one size over a record: what its first half adds to that of all of it.

With z the effect's column and h that of its first half, zero behind it, both are fitted at once,

    y = X b + z c + h d,    X the columns of maps, compliances and other effects,

so that c is the size in the second half, and c + d that in the first one.  The maps are those of
all the record: halves with maps of their own have twice as many unknowns, and of 32 s on the grid
of `rtid init`, 6,398 rows in 776 blocks, 36 degrees of freedom and less than none were left, in
which a leak of 40 standard deviations had a size of 1.4 and 0.2.
"""

from __future__ import annotations

import numpy as np

from rtid.diagnose.bank import columns_of
from rtid.diagnose.commands import commands
from rtid.diagnose.equations import regression_of, softened
from rtid.diagnose.evidence import project, rows_of
from rtid.diagnose.fit import Fit


def between_halves(fitted: Fit, column: int) -> tuple[float, float]:
    """What a column's coefficient is more in the first half of a record, and its deviation.

    fitted: without a bank.
    """
    given = fitted.model, fitted.sent, fitted.weights
    rows = fitted.rows or rows_of(*given, soft=softened(*given, fitted.revision))
    sent = commands(fitted.declared, fitted.chunk)
    columns, _, _ = columns_of(fitted.view, rows.condensed, sent, fitted.weights, fitted.revision)
    whole, first = columns.released(), fitted.first_given
    at, is_first = first + len(whole), np.arange(len(rows.own)) < len(rows.own) // 2
    halved = [column, columns.echo_of[column]] if column in columns.echo_of else [column]
    columns.echo_of |= {at + k: at + 1 for k in range(len(halved) - 1)}
    parts = [{c: is_first * v for c, v in whole[k - first].items()} for k in halved]
    known, projected = fitted.regression, project(rows, [*whole, *parts])
    beside = regression_of(
        fitted.model, fitted.weights, fitted.revision, projected, columns, rows, known.dof
    )
    beside.prior[: len(known.prior)], beside.mean[: len(known.mean)] = known.prior, known.mean
    both = beside.fit((*fitted.estimate.used, at))
    return both.value(at), both.sd(at) * float(np.sqrt(max(1.0, fitted.rho)))
