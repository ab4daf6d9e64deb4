"""What a segment tells: of every block it visits, and of every effect, in units that add up.

A block's information is that of its six terms with the compliances known and the neighbours'
terms projected out, these held by what the rest of a motion will tell of them (KNOWN_SD); an
effect's is 1 / sd^2 of its coefficient as the diagnosis scores it in the segment alone, maps and
present columns projected out.  The sums serve to select; the whole motion is then judged anew
(`prediction`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rtid.diagnose.fit import one_pass
from rtid.diagnose.revision import Revision
from rtid.diagnose.sized import physical
from rtid.diagnose.trials import scored
from rtid.estimator.factor import PRIOR_SD, factorize, one_thread
from rtid.estimator.record import summed
from rtid.estimator.sums import Normal
from rtid.excite.machine import DrivenMachine
from rtid.kernels.layout import TERMS
from rtid.plain import FloatArray, IntArray, Key

PRIOR = np.eye(TERMS) * PRIOR_SD**-2
LEAST_ROWS = 8  # of a block; one that is hardly touched tells nothing
KNOWN_SD = 0.01  # of the neighbours' terms, share of the rated flow


@dataclass(frozen=True)
class Information:
    """blocks (cells, 6, 6), in units of the rated flow, and rows (cells,); effects: 1 / sd^2."""

    cells: IntArray
    blocks: FloatArray
    rows: FloatArray
    effects: dict[Key, float] = field(default_factory=dict)


def of_blocks(machine: DrivenMachine, chunk: FloatArray) -> Information:
    """What samples (n, 2 + signals), SI, tell of the blocks that they visit."""
    sums = summed(machine.model, chunk, machine.weights)
    normal, ns = sums.normal(), sums.n_shared
    stayed = np.flatnonzero(sums.blocks["rows"] >= LEAST_ROWS)
    m, prior = len(stayed), KNOWN_SD**-2
    at = (ns + TERMS * stayed[:, None] + np.arange(TERMS)).ravel()
    gram = normal.gram[np.ix_(at, at)] + prior * np.eye(TERMS * m)
    maps = Normal(gram, normal.right[at], 0.0, normal.noise, normal.rows)
    with one_thread():
        cov = factorize(maps, 0, is_last=True).cov(is_last=True).reshape(m, TERMS, m, TERMS)
        tiles = cov[np.arange(m), :, np.arange(m)]
        information = np.linalg.inv(tiles) - prior * np.eye(TERMS) - PRIOR
    return Information(sums.cells[stayed], information, sums.blocks["rows"][stayed].astype(float))


def of_effects(
    machine: DrivenMachine, chunk: FloatArray, names: tuple[str, ...]
) -> dict[Key, float]:
    """1 / sd^2, SI, of named effects' coefficients, everywhere; chunk (n, 2 + signals)."""
    fit = one_pass(machine.model, chunk, machine.weights, Revision(), None, True, thorough=False)
    by_effect: dict[Key, float] = {}
    for candidate, score in scored(fit):
        if candidate.effect in names:
            sd = physical(fit, candidate, score.sd)
            by_effect[candidate.key] = max(by_effect.get(candidate.key, 0.0), sd**-2)
    return by_effect
