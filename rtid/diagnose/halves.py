"""Whether an effect has one size over a record: what its first half adds to that of all of it.

With z the effect's column and h that of its first half, zero behind it, both are fitted at once,

    y = X b + z c + h d,    X the columns of maps, compliances and other effects,

so that c is the size in the second half, and c + d that in the first one.  Where half of the time
holds next to nothing of z, half of its square does: a pump was asked for more than it gives in the
second minute alone.  The maps are those of all the record: halves with maps of their own have twice
as many unknowns, and of 32 s on the grid of `rtid init`, 6,398 rows in 776 blocks, 36 degrees of
freedom and less than none were left, in which a leak of 40 standard deviations had a size of 1.4
and 0.2.
"""

from __future__ import annotations

import numpy as np

from rtid.diagnose.bank import columns_of
from rtid.diagnose.commands import commands
from rtid.diagnose.equations import regression_of
from rtid.diagnose.evidence import project
from rtid.diagnose.fit import Fit
from rtid.diagnose.regression import Estimate
from rtid.effects.column import Candidate
from rtid.effects.law import Volumes
from rtid.plain import BoolArray

FAIR = 0.1  # of a column's square, that half of a record must have of it to tell its size


def between_halves(fitted: Fit, column: int) -> tuple[float, float]:
    """What a column's coefficient is more in its first half, and the deviation of that.

    The form of an effect is as it stands.  The deviation is inf where one row holds half of the
    column.
    """
    rows = fitted.own_rows
    sent = commands(fitted.declared, fitted.chunk)
    whole, first = list[Volumes](), fitted.first_given
    columns, _, _ = columns_of(
        fitted.view, lambda v, _: whole.append(rows.on_rows(v)), sent, fitted.weights,
        fitted.revision,
    )  # fmt: skip
    at, is_first = first + len(whole), first_half(whole[column - first])
    halved = [column, columns.echo_of[column]] if column in columns.echo_of else [column]
    columns.echo_of |= {at + k: at + 1 for k in range(len(halved) - 1)}
    parts = [{c: is_first * v for c, v in whole[k - first].items()} for k in halved]
    known, projected = fitted.regression, project(rows, [*whole, *parts])
    if not projected.own[at] > 0.0:
        return 0.0, float("inf")
    beside = regression_of(fitted.model, fitted.weights, fitted.revision, projected, columns, rows)
    beside.prior[:at], beside.mean[:at] = known.prior[:at], known.mean[:at]  # none is of a bank
    own = [e for e in fitted.revision.effects if fitted.column(e) == column]
    used = in_its_form(fitted, own[0]).used if own else fitted.estimate.used
    both = beside.fit((*used, at))
    return both.value(at), both.sd(at) * float(np.sqrt(max(1.0, fitted.rho)))


def in_its_form(fitted: Fit, effect: Candidate) -> Estimate:
    """The estimate of a fit in which an effect's form is as it stands, and all else is free.

    Of air the exponent trades with the share: 0.041 +- 0.035 of it were 0.041 +- 0.002 with an
    exponent of 1.1, and halves that were asked for both told neither.
    """
    estimate = fitted.estimate
    form = () if effect.is_whole else fitted.shape_columns(effect).values()
    if not form:
        return estimate
    return fitted.regression.fit(tuple(k for k in estimate.used if k not in form))


def first_half(volumes: Volumes) -> BoolArray:
    """True (rows,) in the first half of a record, or of a column, m3, that is in one of them."""
    passed = np.cumsum(np.sum([series**2 for series in volumes.values()], axis=0))
    is_first = np.arange(len(passed)) < len(passed) // 2
    share = passed[is_first][-1] / max(passed[-1], 1e-300)
    return is_first if FAIR <= share <= 1.0 - FAIR else passed <= 0.5 * passed[-1]
