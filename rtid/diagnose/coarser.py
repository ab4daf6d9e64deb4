"""A grid no finer than its record can carry, in the one fit that everything reads.

Six terms of a block want rows of its own: where a record has too few for each unknown of the blocks
that it visits, most of them are known badly, next to nothing of the held-out part can be judged,
and what the noise leaves is less than one per row.  Then every second border goes, and again; what
the finer grid showed, at the corner of a dead band say, `finer` lays anew where the record asks for
it.  A record is as it is: the grid is the program's business, not its user's.
"""

from __future__ import annotations

from rtid.diagnose.fit import Fit, fit, prepare
from rtid.diagnose.search import coarse
from rtid.kernels.layout import TERMS
from rtid.model import PROPORTIONAL

ROUNDS = 3
LEAST_ROWS = 2.5  # scalar rows of 10 ms for each unknown of a visited block


def carried(present: Fit) -> Fit:
    """The fit on the finest of its grids that has rows enough; as it is where it has.

    Of proportional maps none: they have one gain in each block on purpose.
    """
    if any(edge.basis == PROPORTIONAL for edge in present.declared.edges):
        return present
    for _ in range(ROUNDS):
        machine = coarse(present.declared)
        if _has_enough(present) or machine.n_cells == present.declared.n_cells:
            break
        record = machine, present.chunk, prepare(machine, present.chunk)
        present = fit(*record, present.revision, bank=False)
    return present


def _has_enough(present: Fit) -> bool:
    return present.regression.rows >= LEAST_ROWS * TERMS * len(present.map.cells)
