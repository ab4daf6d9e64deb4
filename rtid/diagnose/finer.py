"""A grid as fine as its record needs it, in the one fit that everything reads.

Before a record is said to be unexplained, the intervals whose terms miss the flow are halved.  A
finer grid is kept where chi2 falls by more than k unknowns more would make it fall by chance, and
by so much again that it predicts better; and where most of what was missed in the halved intervals
is gone.  Half the width leaves 1/64 of what six terms miss of a cubic, and 1/8 at a corner; a
missing effect hardly heeds the grid, and stays for the search: a leak that left rho 25 was
swallowed down to 7 by grids that only had to explain a part.  Of a valve that opens with a jump
half the width leaves a half; a border on the jump leaves next to nothing (`jumps`).

What the terms miss by a little in every interval is clear in none of them, and no single one pays:
where rho stays off its band by a little, all are halved along one axis (`halved_throughout`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from rtid.diagnose.excuse import few_excused, left_over
from rtid.diagnose.fit import Fit, fit, one_pass, prepare
from rtid.diagnose.jumps import cut_at_jumps
from rtid.estimator.misfit import Misfit, can_be_explained
from rtid.estimator.refine import CLEARLY, halved, halved_along, in_halved, parents
from rtid.estimator.state import Weights
from rtid.model import Grid, Machine
from rtid.plain import BoolArray

ROUNDS = 6
HARDLY = 1.5  # standard deviations: tried where no interval is clear and rho is off its band
WORTH = 2.0  # chi2 per unknown more, by which a finer grid predicts better
BY_CHANCE = 4.0  # standard deviations of what unknowns more explain by chance
LEFT = 0.35  # of the misfit in the halved intervals, at most: 1/8 at a corner, 1/64 of a cubic
LITTLE = 1.5  # rho from which on a misfit is no matter of the grid's detail alone
MOST_BLOCKS = 600  # that are all halved: a solution's time grows with their cube
LEFT_OF_A_JUMP = 0.7  # of all that is missed, at most: nearly all of what is missing would be
FURTHER = 0.95  # of what is missed, at most, for others to be looked for beside these borders


def fine_enough(present: Fit) -> tuple[Fit, Misfit | None]:
    """The fit on a grid with the intervals halved that miss the flow, as it is where none does.

    With it what it leaves, where that is known: the next who asks need not find it again.
    """
    if not can_be_explained(present.sent):
        return present, None
    declared = present.declared
    present, rest = _finest(present, left_over(present))  # the first one's rows are large
    if present.declared is declared:
        return present, rest
    present = _to_the_end(present)
    has_jumps = present.declared.gates != declared.gates
    if has_jumps and not _is_in_band(present):
        present = _with_its_lag(present, declared)
    return present, None


def finer_beside(present: Fit) -> Fit:
    """As `fine_enough`, of a fit that may have blocks excused."""
    if not can_be_explained(present.sent):
        return present
    return fine_enough(_on_grid(present, present.declared))[0]


def halved_throughout(present: Fit) -> Fit:
    """The fit on a grid halved along one axis, where that explains a rho a little too large.

    chi2 must fall by clearly more than chance makes it (the unknowns that the data know, not six a
    block), and most of the misfit must be gone, as of a smooth curve; on clean machines that were
    an alarm at rho 1.11 and 1.13 it fell by 10 standard deviations more, and 0.3 of the misfit were
    left.  Of weak effects 0.5 and more stay: a leak that left rho 1.25 left 1.12.
    """
    is_little = 1.0 + present.spread_of_rho <= present.rho < LITTLE
    is_small = len(present.map.cells) <= MOST_BLOCKS
    if not (is_little and is_small and can_be_explained(present.sent)):
        return present
    plain = present
    if present.weights.missed.any():  # what its blocks are excused hides what halving would gain
        plain = _on_grid(present, present.declared).light()
    for axis in (1, 0):
        trial = _on_grid(present, halved_along(present.declared, axis))
        more = max(1.0, plain.regression.dof - trial.regression.dof)
        is_clear = plain.held.sse - trial.held.sse > more + BY_CHANCE * float(np.sqrt(2.0 * more))
        # where rho is no smaller, twice the blocks follow noise and effects alike
        if is_clear and trial.rho < plain.rho:
            better = few_excused(_to_the_end(trial))
            if better.rho - 1.0 < LEFT * (present.rho - 1.0):
                return better
    return present


def _finest(present: Fit, rest: Misfit) -> tuple[Fit, Misfit]:
    """A pass on the finest grid that is worth it, and what it leaves; rest: the present one's."""
    clearly = CLEARLY
    for _ in range(ROUNDS):
        machine = halved(present.declared, rest, clearly)
        if machine.n_cells > present.declared.n_cells:
            better = _better(present, rest, machine) or _about_a_jump(present, rest)
            if better is None:
                break
            present, rest = better
        elif clearly == HARDLY or _is_in_band(present):
            break
        else:
            clearly = HARDLY
    return present, rest


def on_grids(model: Machine, grids: Iterable[Grid], hysteresis: float) -> Machine:
    """The machine with these grids of its edges, and blocks that are left by so much (`Gates`)."""
    pairs = zip(model.edges, grids, strict=True)
    gates = replace(model.gates, hysteresis=hysteresis)
    return replace(model, edges=tuple(replace(e, grid=g) for e, g in pairs), gates=gates)


def _better(present: Fit, rest: Misfit, machine: Machine) -> tuple[Fit, Misfit] | None:
    """A pass on the finer grid of a machine, and what it leaves; None where it is not worth it.

    rest: what the present one leaves.
    """
    trial = _on_grid(present, machine)
    if not _is_worth(present, trial):
        return None
    after = left_over(trial.unfactored())  # the next finer grid lets go of it anyway
    here = in_halved(present.declared, machine, rest)
    gone = _beyond(after, here) < LEFT * _beyond(rest, here)
    return (trial, after) if gone else None


def _about_a_jump(present: Fit, rest: Misfit) -> tuple[Fit, Misfit] | None:
    """As `_better`, with borders where the maps jump.

    Time after time, each beside those before: of four edges that open within 3 % of the command
    the first borders explain a quarter of what is missed, and all together nearly all.
    """
    before, most, better = present, present.rho - 1.0, None
    for _ in range(ROUNDS):
        if _is_in_band(before):
            break
        machine = cut_at_jumps(before, rest)
        if machine.n_cells == before.declared.n_cells:
            break
        trial = _on_grid(before, machine)
        if not (trial.rho - 1.0 < FURTHER * (before.rho - 1.0) and _is_worth(before, trial)):
            break
        before, rest, most = trial, left_over(trial), LEFT_OF_A_JUMP * most
        better = (trial, rest) if trial.rho - 1.0 < most else better
    return better


def _with_its_lag(present: Fit, declared: Machine) -> Fit:
    """The fit on the grid that a declared one becomes with this fit's lag, where that is better.

    A border where a map jumps lies as far off as the lag that it was looked for with.
    """
    weights = _own_weights(present, declared)
    record = declared, present.chunk, weights, present.revision
    again = one_pass(*record, None, bank=False, thorough=False)
    again = _to_the_end(_finest(again, left_over(again))[0])
    return again if again.rho < present.rho else present


def _on_grid(present: Fit, machine: Machine) -> Fit:
    """A pass of the present revision on a finer grid, its rows weighed as they are.

    So chi2 of the two can be compared; what the coarse blocks miss is excused no longer.
    """
    known = present.unfactored().weights
    slopes = known.slopes[parents(present.declared, machine)]
    weights = Weights(slopes, known.compliance, known.lag_s)
    record = machine, present.chunk, weights, present.revision
    return one_pass(*record, None, bank=False, thorough=False, sent=present.sent)


def _to_the_end(trial: Fit) -> Fit:
    """The revision fitted to the end on its new grid, whose own slopes weigh the rows."""
    weights = _own_weights(trial.unfactored(), trial.declared)
    return fit(trial.declared, trial.chunk, weights, trial.revision, trial, bank=False)


def _own_weights(known: Fit, machine: Machine) -> Weights:
    """Weights by the slopes of a machine's own grid, with the lag and the moduli of a fit."""
    weights = prepare(machine, known.chunk)
    return replace(weights, lag_s=known.weights.lag_s, compliance=known.weights.compliance)


def _beyond(rest: Misfit, here: BoolArray) -> float:
    """Squared innovations of the rows `here` (n - 1,) beyond one each."""
    return float(np.nansum(rest.innovation[here] ** 2 - 1.0))


def _is_worth(present: Fit, trial: Fit) -> bool:
    more = max(1.0, present.regression.dof - trial.regression.dof)
    gain = present.held.sse - trial.held.sse
    return gain > max(WORTH * more, more + BY_CHANCE * float(np.sqrt(2.0 * more)))


def _is_in_band(fitted: Fit) -> bool:
    """True where rho is off 1 by no more than so long a record gives; rare blocks are not free."""
    return fitted.rho < 1.0 + fitted.spread_of_rho
