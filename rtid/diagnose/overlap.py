"""Whether a valve leaks at its seat, or opens within the band in which it is taken for shut.

What passes the gap of a seat does so at every command below the band.  What passes an opening falls
with the command, and ends.  Maps that begin some steps below the band, and are shut from there on,
hold whatever changes with the command there, and no more of a seat leak than passes within them:

    a seat leak, shut at the band:        one number,  K sqrt(dp) at all w below it
    an opening, shut k steps below it:    k rows of blocks, nothing at any w below these

An underlapped spool, whose four edges stand open at rest, left 2.8 times the noise where its maps
began at no command, and a seat leak and a relief valve explained it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rtid.diagnose.admission import LEAST_SHARE
from rtid.diagnose.fit import Fit, fit, prepare
from rtid.diagnose.trials import TIE, AcceptedEffect
from rtid.effects import catalogue, correcting
from rtid.effects.page import OPENING
from rtid.model import Edge, Grid, Machine
from rtid.plain import Key

STEPS, SHARE = (1, 2, 4), 1.0 / 24.0  # below the band; of an edge's range, each of them


@dataclass(frozen=True)
class EarlierOpening:
    """The likeliest of the machines that open earlier: their steps below the band, its fit.

    won: how far -2 log likelihood falls to it from what was found with the band as it was; least:
    by how much that must be to be believed.
    """

    steps: int
    fit: Fit
    won: float
    least: float

    @property
    def is_likelier(self) -> bool:
        """Whether the record speaks for it, beyond chance."""
        return self.won > self.least

    @property
    def is_refuted(self) -> bool:
        """Whether the record speaks against it, beyond chance."""
        return self.won < -self.least


def opened_earlier(model: Machine, steps: int) -> Machine:
    """The machine whose valves open so many steps below the bands that it declares, if any."""
    return replace(model, edges=tuple(_earlier(edge, steps) for edge in model.edges))


def _earlier(edge: Edge, steps: int) -> Edge:
    """An edge with more borders below its first one, shut below them; as it is without a band."""
    u = edge.grid.u_v
    if not np.isfinite(edge.safe_band_v):
        return edge
    step = SHARE * float(u[-1] - u[0])
    more = float(u[0]) - step * np.arange(steps, 0, -1)
    grid = Grid(np.concatenate([more, u]), edge.grid.dp_pa)
    return replace(edge, grid=grid, safe_band_v=float(more[0]))


def seats() -> frozenset[str]:
    """The effects that go on below a band, and are alike to an opening within it."""
    (shift,) = correcting(OPENING)
    pages = catalogue().values()
    return frozenset(
        page.name
        for page in pages
        if page.kind == shift.kind and shift.name in page.confounders and not page.no_law
    )


def likeliest_opening(present: Fit) -> EarlierOpening | None:
    """The likeliest earlier opening beside a fit; None where no valve has a band.

    Each with all that was found but seat leaks, and with nothing: what only made up for an opening
    is not needed with it.
    """
    if not any(np.isfinite(edge.safe_band_v) for edge in present.declared.edges):
        return None
    least = max(TIE * max(1.0, present.rho), LEAST_SHARE * present.excess)
    best: EarlierOpening | None = None
    for steps in STEPS:
        for there in _opened(present, steps):
            won = there.wins_over(present)
            if best is None or won > best.won + (TIE if there.revision.n_causes else 0.0):
                best = EarlierOpening(steps, there.light(), won, least)
        if best is None or best.steps != steps:
            break
    return best


def _opened(present: Fit, steps: int) -> Iterator[Fit]:
    """Fits of the machine that opens earlier: bare, and beside what was found but seat leaks."""
    machine, known = opened_earlier(present.declared, steps), present.weights
    weights = prepare(machine, present.chunk)
    weights = replace(weights, lag_s=known.lag_s, compliance=known.compliance)
    old = present.revision
    rest = tuple(e for e in old.effects if e.effect not in seats())
    bare = replace(old, effects=(), timings=(), sizes=())
    for revision in dict.fromkeys((bare, replace(old, effects=rest, sizes=()))):
        yield fit(machine, present.chunk, weights, revision, bank=False)


def beside_openings(effects: list[AcceptedEffect], present: Fit) -> list[AcceptedEffect]:
    """What was found, with the openings that the record does not tell from a seat's leak.

    Where these are likelier, without what only made up for them.  What is not told from a seat leak
    is no opening where nothing speaks for one: the band was declared to be shut.
    """
    leaks = [f for f in effects if any(name in seats() for name, _ in (f.key, *f.alike))]
    opening = likeliest_opening(present) if leaks else None
    if opening is None or opening.is_refuted:
        return effects
    if opening.is_likelier:
        effects = [f for f in effects if f in leaks or opening.fit.revision.has(f.key)]
    likely = leaks if opening.is_likelier else [f for f in leaks if f.key[0] in seats()]
    return [_with_opening(f) if f in likely else f for f in effects]


def _with_opening(seat: AcceptedEffect) -> AcceptedEffect:
    (shift,), keys = correcting(OPENING), (seat.key, *seat.alike)
    shifts: list[Key] = [(shift.name, where) for name, where in keys if name in seats()]
    return replace(seat, alike=tuple(dict.fromkeys((*seat.alike, *shifts))))
