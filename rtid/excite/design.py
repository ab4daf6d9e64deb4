"""Design a motion: candidates within the limits, the best of them in a row, and what it will tell.

Every candidate is run on the nominal machine, which must keep the limits with a margin: what goes
too far or too fast is run again smaller.  The whole motion is run at the end; a segment that breaks
a limit beside the others is left out, and the time filled anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtid.diagnose.trials import Key
from rtid.estimator.sums import IntArray
from rtid.excite.driving import SHUT, STEP_S, SUPPLY
from rtid.excite.information import Information, of_blocks, of_effects
from rtid.excite.library import REST_S, Segment, home_m, library
from rtid.excite.limits import Extremes, LimitError, Limits, extremes, require_kept
from rtid.excite.machine import Machine, MachineError
from rtid.excite.prediction import Prediction, assess
from rtid.excite.selection import (
    BOUNDED,
    EFFECT_WEIGHT,
    Criterion,
    Known,
    Problem,
    choose,
    filled,
    standard_errors,
)
from rtid.excite.sweep import swept_sine
from rtid.model import FloatArray

MARGIN, PRESSURE_MARGIN = 0.05, 0.02  # of a range, kept free on the nominal machine
ELSEWHERE = 0.02  # weight of a block that the working motion does not visit
GOAL, IMPROVED, WORTH = 5e-3, 0.2, 0.25  # see `missing`; the goal is a share of the rated flow
ROWS = 20  # that a block needs to be where the machine works
TRIES, MOST_LEFT_OUT = 5, 50  # to fit a segment into the limits; to put a motion together
SCALED, SHRINK = frozenset({"position", "speed"}), 0.01  # what shrinks with a segment; and beyond

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Candidate:
    """A feasible segment and what it tells."""

    segment: Segment
    told: Information


@dataclass(frozen=True)
class Design:
    """A motion: segments in order, reference (n, 5) as `driving`, expected noise-free samples."""

    machine: Machine
    limits: Limits
    segments: tuple[Candidate, ...]
    reference: FloatArray
    expected: FloatArray
    extremes: tuple[Extremes, ...]
    weights: FloatArray

    @property
    def duration_s(self) -> float:
        """Its length."""
        return len(self.reference) * STEP_S

    def predicted(self, name: str = "designed", effects: bool = True) -> Prediction:
        """What it will tell, before the machine has moved."""
        return assess(self.machine.model, self.machine.measured(self.expected), name, effects)


def _silent(_what: str, _share: float) -> None:
    pass


def design(
    machine: Machine,
    limits: Limits,
    known: Known | None,
    pool: Sequence[Candidate],
    criterion: Criterion = BOUNDED,
) -> Design:
    """Choose a motion from `candidates` of the same machine and limits.

    known: what is learned already.  Raises LimitError, MachineError.
    """
    weights, inner = working_weights(machine, limits), tightened(limits)
    start = known or Known.nothing(machine.model.n_cells)
    costs = np.array([c.segment.duration_s + 2 * REST_S for c in pool])
    problem = Problem([c.told for c in pool], costs, weights, criterion)
    chosen = choose(problem, start, limits.duration_s)
    for _ in range(MOST_LEFT_OUT):
        if not chosen:
            raise LimitError("no segment is worth running", "more time, or wider limits: [excite]")
        chosen.sort(key=lambda k: pool[k].segment.reference[0, SUPPLY])
        segments, reference, playing = stitched([pool[k] for k in chosen], limits)
        expected = machine.run(reference)
        bad = {
            id(segment)
            for k, segment in enumerate(segments)
            if not _keeps(machine, inner, reference[playing == k], expected[playing == k])
        }
        if not bad:
            break
        costs[[k for k, c in enumerate(pool) if id(c) in bad]] = np.inf  # it fits no more
        rest = [k for k in chosen if id(pool[k]) not in bad]
        chosen = filled(problem, start.copy(), rest, limits.duration_s)
    found = checked(machine, limits, reference, expected)
    require_kept(found)
    return Design(machine, limits, tuple(segments), reference, expected, found, weights)


def candidates(
    machine: Machine, limits: Limits, see: tuple[str, ...] = (), progress: Progress = _silent
) -> list[Candidate]:
    """Segments of the library that the nominal machine can follow, and what each tells."""
    found, every, tight = list[Candidate](), library(limits), tightened(limits)
    for k, segment in enumerate(every):
        progress("trying segments", k / len(every))
        fitting = _fitted(machine, tight, segment)
        if fitting is not None:
            kept, chunk = fitting
            chunk = machine.measured(chunk, k)
            told = of_blocks(machine, chunk)
            if see:
                told = replace(told, effects=of_effects(machine, chunk, see))
            found.append(Candidate(kept, told))
    if not found:
        raise LimitError(
            "the nominal machine can follow no segment within the limits",
            "are load, controller and supply of [excite] right?",
        )
    return found


def _fitted(
    machine: Machine, limits: Limits, segment: Segment
) -> tuple[Segment, FloatArray] | None:
    """The segment, smaller where it must be, and its noise-free samples; None: it does not fit."""
    home = home_m(limits)
    for _ in range(TRIES):
        try:
            chunk = machine.run(segment.reference)
        except MachineError:
            return None
        broken = {e.quantity: e for e in checked(machine, limits, segment.reference, chunk)
                  if not e.is_kept}  # fmt: skip
        if not broken:
            return segment, chunk
        if not broken.keys() <= SCALED:
            return None
        share = min(_share_within(e, home if q == "position" else 0.0) for q, e in broken.items())
        segment = segment.scaled(share - SHRINK, home)
    return None


def _keeps(machine: Machine, limits: Limits, reference: FloatArray, chunk: FloatArray) -> bool:
    """Whether a run, or a part of one, keeps its limits."""
    return all(e.is_kept for e in checked(machine, limits, reference, chunk))


def _share_within(e: Extremes, centre: float) -> float:
    """By how much an excursion from the centre must shrink to stay within its limit."""
    above = (e.most - centre) / max(e.high - centre, e.most - centre)
    below = (centre - e.least) / max(centre - e.low, centre - e.least, 1e-12)
    return min(above, below) if centre > e.least else above


def working_weights(machine: Machine, limits: Limits) -> FloatArray:
    """Weight of every grid cell: 1 where the paper's sweep at the usual supply works."""
    told = of_blocks(machine, machine.measured(machine.run(swept_sine(machine, limits))))
    weights = np.full(machine.model.n_cells, ELSEWHERE)
    weights[told.cells[told.rows >= ROWS]] = 1.0
    return weights


@dataclass(frozen=True)
class Missing:
    """Grid cells (m,) and effects that are not known well enough, and the segments that tell them.

    Only what some segment of those that were tried would tell; segments: the most telling first.
    """

    cells: IntArray
    effects: tuple[Key, ...]
    segments: tuple[Candidate, ...]
    tells: tuple[frozenset[int | Key], ...]  # which of the cells and effects each segment improves

    def pieces(self, most: int) -> list[tuple[Candidate, int]]:
        """A few segments that tell most together, each with how much it adds to those before."""
        found, open_ = list[tuple[Candidate, int]](), set[int | Key]().union(*self.tells)
        while open_ and len(found) < most:
            best = max(range(len(self.tells)), key=lambda k: len(self.tells[k] & open_))
            found.append((self.segments[best], len(self.tells[best] & open_)))
            open_ -= self.tells[best]
        return found


def missing(segments: Sequence[Candidate], known: Known, weights: FloatArray) -> Missing:
    """What is still missing by what is learned, and the segments that are worth running for it.

    Worth running is what improves blocks that are not known to GOAL, or named effects, by a share
    IMPROVED of their standard error, as long as these are a share WORTH of what it visits.
    """
    found = [_improved(c.told, known) for c in segments]
    pairs = zip(segments, found, strict=True)
    shares = np.array([_share(c.told, better, weights) for c, better in pairs])
    order = [k for k in np.argsort(-shares, kind="stable").tolist() if shares[k] >= WORTH]
    tells = tuple(found[k] for k in order)
    every = frozenset[int | Key]().union(*tells)
    cells = sorted(cell for cell in every if isinstance(cell, int))
    effects = sorted(key for key in every if not isinstance(key, int))
    kept = tuple(segments[k] for k in order)
    return Missing(np.array(cells, dtype=np.int64), tuple(effects), kept, tells)


def _improved(told: Information, known: Known) -> frozenset[int | Key]:
    """Cells and effects that a segment would still improve."""
    own = known.blocks[told.cells]
    before, after = standard_errors(own), standard_errors(own + told.blocks)
    cells = told.cells[(before > GOAL) & (after < (1.0 - IMPROVED) * before)]
    effects = [
        key
        for key, value in told.effects.items()
        if (known.effects.get(key, 0.0) + value) * (1.0 - IMPROVED) ** 2
        > known.effects.get(key, 0.0)
    ]
    return frozenset[int | Key]([*cells.tolist(), *effects])


def _share(told: Information, better: frozenset[int | Key], weights: FloatArray) -> float:
    """Share of what a segment visits, by weight, that it would still improve."""
    total = float(weights[told.cells].sum()) + EFFECT_WEIGHT * len(told.effects)
    gained = sum(weights[key] if isinstance(key, int) else EFFECT_WEIGHT for key in better)
    return float(gained / max(total, 1e-12))


def stitched(
    segments: Sequence[Candidate], limits: Limits
) -> tuple[list[Candidate], FloatArray, NDArray[np.intp]]:
    """One reference from segments in a row, the supply led over at rest; as many as fit.

    Segments that fit, the reference (n, 5), and which of the segments each sample (n,) belongs to.
    """
    parts, kept, left = list[FloatArray](), list[Candidate](), round(limits.duration_s / STEP_S)
    for candidate in segments:
        row = candidate.segment.reference[:1]
        lead = row
        if parts:
            change = row[0, SUPPLY] - parts[-1][-1, SUPPLY]
            steps = max(
                round(REST_S / STEP_S),
                int(np.ceil(abs(change) / limits.supply_rate_paps / STEP_S)) + 1,
            )
            lead = np.repeat(row, steps, axis=0)
            lead[:, SUPPLY] = row[0, SUPPLY] - change * (1.0 - np.arange(1, steps + 1) / steps)
            lead[:, SHUT] = 0.0
        if len(lead) + len(candidate.segment.reference) > left:
            continue
        parts += [lead, candidate.segment.reference]
        kept.append(candidate)
        left -= len(lead) + len(candidate.segment.reference)
    lengths = [len(lead) + len(part) for lead, part in zip(parts[::2], parts[1::2], strict=True)]
    return kept, np.concatenate(parts), np.repeat(np.arange(len(kept)), lengths)


def checked(
    machine: Machine, limits: Limits, reference: FloatArray, chunk: FloatArray
) -> tuple[Extremes, ...]:
    """The quantities of a run beside their limits."""
    places = machine.places
    x, u = machine.signal(chunk, places.x), machine.signal(chunk, places.u)
    return extremes(limits, reference, chunk[:, 0], x, u, machine.pressures(chunk))


def tightened(limits: Limits) -> Limits:
    """The limits with a margin for what the true machine does otherwise."""

    def inner(span: tuple[float, float], share: float) -> tuple[float, float]:
        slack = share * (span[1] - span[0])
        return span[0] + slack, span[1] - slack

    return replace(
        limits,
        stroke_m=inner(limits.stroke_m, MARGIN),
        pressure_pa=inner(limits.pressure_pa, PRESSURE_MARGIN),
        speed_mps=(1.0 - MARGIN) * limits.speed_mps,
    )
