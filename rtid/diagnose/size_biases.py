"""What makes the size of a leak another one than it is: noisy pressures, and terms that miss a map.

The terms of the maps are made of pressures as they are measured, whose noise flattens the maps:
what they leave of the record then feigns a leak, or hides one.  `attenuation` tells the size
without it, to first order: where it is much, as much again may be left, either way.

What six terms miss of a map is alike in all blocks, as is what they leave of a leak: a fit takes
one for the other.  Half the spacing leaves 1/8 to 1/2 of it.  With d what a size moves by there,
and v the noise of that, the difference of the two variances (Hausman, Econometrica 46 (1978) 1251),

    b = w d,    w = t^2 / (t^2 + v),    t^2 = max(0, d^2 - v)

is taken off, with the variance w v, and as much as b again may be left, either way.  A third
party's leak was 1.6 % too large on sweeps: 1.5 % of that is gone on half the spacing.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rtid.diagnose.attenuation import NOTHING_TOLD, Believed, sizes_apart_from_noise
from rtid.diagnose.consequence import on_finer
from rtid.diagnose.fit import Fit
from rtid.diagnose.rising import NO_BIAS, Rising, SizeBias, given_volumes, risings
from rtid.units import UNIFORM

MOST_BLOCKS = 300  # that are all halved: of 395 the solution took 6.5 s and 450 MB


def size_biases(fitted: Fit, risen: Mapping[int, Rising]) -> dict[int, SizeBias]:
    """Of the sizes of flows of a fit with its rows, by column; risen: how each goes with pressure.

    What each is over the whole record, less the pressures' noise, on a grid that is fine enough.
    """
    over = {column: rising.bias for column, rising in risen.items()}
    if not over or not fitted.view.has_pressures:
        return over
    known = sizes_apart_from_noise(fitted, [*over])
    here = {column: _over_the_record(known[column], over[column]) for column in over}
    there = _on_finer(fitted, [*over])
    return {
        column: _of_noise(fitted, known[column], column)
        .beside(over[column])
        .beside(_of_grid(fitted.rho, here[column], there.get(column, NOTHING_TOLD)))
        for column in over
    }


def _on_finer(fitted: Fit, columns: list[int]) -> dict[int, Believed]:
    """Sizes over the record on half the spacing, by the fit's columns.

    None of blocks that are too many, as of motion that goes everywhere, or too rare.
    """
    finer = on_finer(fitted) if len(fitted.map.cells) <= MOST_BLOCKS else None
    if finer is None:
        return {}
    pairs = zip(fitted.revision.effects, finer.revision.effects, strict=True)
    flows = {fitted.column(e): there for e, there in pairs if fitted.column(e) in columns}
    over = risings(finer, given_volumes(finer), [*flows.values()])
    known = sizes_apart_from_noise(finer, [*over])
    at = {column: finer.column(flow) for column, flow in flows.items()}
    return {column: _over_the_record(known[k], over[k].bias) for column, k in at.items()}


def _over_the_record(known: Believed, over: SizeBias) -> Believed:
    """A size over the whole record."""
    sd = float(np.hypot(known.sd, over.sd))
    return Believed(known.size + over.shift, sd, known.sd_by_blocks)


def _of_noise(fitted: Fit, known: Believed, column: int) -> SizeBias:
    """What the pressures' noise has made of a size.

    None where it is as large as what the maps leave: to first order nothing is known of it then.
    """
    if not np.isfinite(known.sd):
        return NO_BIAS
    more = max(1.0, fitted.rho) * max(0.0, known.sd**2 - fitted.estimate.sd(column) ** 2)
    shift = known.size - fitted.estimate.value(column)
    return SizeBias(shift, float(np.hypot(np.sqrt(more), shift / UNIFORM)))


def _of_grid(rho: float, here: Believed, there: Believed) -> SizeBias:
    """What the terms' misfit has made of a size, by what it is on half the spacing."""
    if not (np.isfinite(here.sd) and np.isfinite(there.sd)):
        return NO_BIAS
    moved, noise = there.size - here.size, max(1.0, rho) * max(0.0, there.sd**2 - here.sd**2)
    beyond = max(0.0, moved**2 - noise)
    if beyond == 0.0:
        return NO_BIAS
    share = beyond / (beyond + noise)
    return SizeBias(share * moved, float(np.hypot(np.sqrt(share * noise), share * moved / UNIFORM)))
