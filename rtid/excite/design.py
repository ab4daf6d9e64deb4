"""Design a motion: candidates within the limits, the best of them in a row, and what it will tell.

Every candidate is run on the nominal machine, which must keep the limits with a margin: what goes
too far or too fast is run again smaller.  The whole motion is run at the end; a segment that breaks
a limit beside the others is left out, and the time filled anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtid.excite.driving import SHUT, STEP_S, SUPPLY
from rtid.excite.information import Information, of_blocks, of_effects
from rtid.excite.library import REST_S, Segment, home_m, library
from rtid.excite.machine import DrivenMachine, MachineError
from rtid.excite.motion_limits import Extremes, LimitError, Limits, extremes, require_kept
from rtid.excite.prediction import Prediction, assess
from rtid.excite.selection import (
    BOUNDED,
    EFFECT_WEIGHT,
    Criterion,
    KnownCells,
    SelectionProblem,
    choose,
    filled,
    standard_errors,
)
from rtid.excite.sweep import swept_sine
from rtid.plain import FloatArray, IntArray, Key, Progress, silent

MARGIN, PRESSURE_MARGIN = 0.05, 0.02  # of a range, kept free on the nominal machine
ELSEWHERE = 0.02  # weight of a block that the working motion does not visit
GOAL, IMPROVED, WORTH = 5e-3, 0.2, 0.25  # see `missing`; the goal is a share of the rated flow
ROWS = 20  # that a block needs to be where the machine works
TRIES, MOST_LEFT_OUT = 5, 50  # to fit a segment into the limits; to put a motion together
SCALED, SHRINK = frozenset({"position", "speed"}), 0.01  # what shrinks with a segment; and beyond


@dataclass(frozen=True)
class CandidateSegment:
    """A feasible segment and what it tells."""

    segment: Segment
    told: Information


@dataclass(frozen=True)
class Design:
    """A motion: segments in order, reference (n, 5) as `driving`, expected noise-free samples."""

    machine: DrivenMachine
    limits: Limits
    segments: tuple[CandidateSegment, ...]
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


def design(
    machine: DrivenMachine,
    limits: Limits,
    known: KnownCells | None,
    pool: Sequence[CandidateSegment],
    criterion: Criterion = BOUNDED,
) -> Design:
    """Choose a motion from `candidates` of the same machine and limits.

    known: what is learned already.  Raises LimitError, MachineError.
    """
    weights, inner = working_weights(machine, limits), tightened(limits)
    start = known or KnownCells.nothing(machine.model.n_cells)
    costs = np.array([c.segment.duration_s + 2 * REST_S for c in pool])
    problem = SelectionProblem([c.told for c in pool], costs, weights, criterion)
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
    result = checked(machine, limits, reference, expected)
    require_kept(result)
    return Design(machine, limits, tuple(segments), reference, expected, result, weights)


def candidates(
    machine: DrivenMachine, limits: Limits, see: tuple[str, ...] = (), progress: Progress = silent
) -> list[CandidateSegment]:
    """Segments of the library that the nominal machine can follow, and what each tells."""
    segments, every, tight = list[CandidateSegment](), library(limits), tightened(limits)
    for k, segment in enumerate(every):
        progress("trying segments", k / len(every))
        fitting = _fitted(machine, tight, segment)
        if fitting is not None:
            kept, chunk = fitting
            chunk = machine.measured(chunk, k)
            information = of_blocks(machine, chunk)
            if see:
                information = replace(information, effects=of_effects(machine, chunk, see))
            segments.append(CandidateSegment(kept, information))
    if not segments:
        raise LimitError(
            "the nominal machine can follow no segment within the limits",
            "are load, controller and supply of [excite] right?",
        )
    return segments


def _fitted(
    machine: DrivenMachine, limits: Limits, segment: Segment
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


def _keeps(
    machine: DrivenMachine, limits: Limits, reference: FloatArray, chunk: FloatArray
) -> bool:
    """Whether a run, or a part of one, keeps its limits."""
    return all(e.is_kept for e in checked(machine, limits, reference, chunk))


def _share_within(e: Extremes, centre: float) -> float:
    """By how much an excursion from the centre must shrink to stay within its limit."""
    above = (e.most - centre) / max(e.high - centre, e.most - centre)
    below = (centre - e.least) / max(centre - e.low, centre - e.least, 1e-12)
    return min(above, below) if centre > e.least else above


def working_weights(machine: DrivenMachine, limits: Limits) -> FloatArray:
    """Weight (cells,), dimensionless: 1 where the paper's sweep at the usual supply works."""
    information = of_blocks(machine, machine.measured(machine.run(swept_sine(machine, limits))))
    weights = np.full(machine.model.n_cells, ELSEWHERE)
    weights[information.cells[information.rows >= ROWS]] = 1.0
    return weights


@dataclass(frozen=True)
class Missing:
    """Grid cells (m,) and effects that are not known well enough, and the segments that tell them.

    Only what some segment of those that were tried would tell; segments: the most telling first.
    """

    cells: IntArray
    effects: tuple[Key, ...]
    segments: tuple[CandidateSegment, ...]
    tells: tuple[frozenset[int | Key], ...]  # which of the cells and effects each segment improves

    def pieces(self, most: int) -> list[tuple[CandidateSegment, int]]:
        """A few segments that tell most together, each with how much it adds to those before."""
        pieces, open_ = list[tuple[CandidateSegment, int]](), set[int | Key]().union(*self.tells)
        while open_ and len(pieces) < most:
            best = max(range(len(self.tells)), key=lambda k: len(self.tells[k] & open_))
            pieces.append((self.segments[best], len(self.tells[best] & open_)))
            open_ -= self.tells[best]
        return pieces


def missing(
    segments: Sequence[CandidateSegment], known: KnownCells, weights: FloatArray
) -> Missing:
    """What is still missing by what is learned, and the segments that are worth running for it.

    Worth running is what improves blocks that are not known to GOAL, or named effects, by a share
    IMPROVED of their standard error, as long as these are a share WORTH of what it visits.
    weights (cells,): as of `working_weights`.
    """
    improved = [_improved(c.told, known) for c in segments]
    pairs = zip(segments, improved, strict=True)
    shares = np.array([_share(c.told, better, weights) for c, better in pairs])
    order = [k for k in np.argsort(-shares, kind="stable").tolist() if shares[k] >= WORTH]
    tells = tuple(improved[k] for k in order)
    every = frozenset[int | Key]().union(*tells)
    cells = sorted(cell for cell in every if isinstance(cell, int))
    effects = sorted(key for key in every if not isinstance(key, int))
    kept = tuple(segments[k] for k in order)
    return Missing(np.array(cells, dtype=np.int64), tuple(effects), kept, tells)


def _improved(information: Information, known: KnownCells) -> frozenset[int | Key]:
    """Cells and effects that a segment would still improve."""
    known_blocks = known.blocks[information.cells]
    before = standard_errors(known_blocks)
    after = standard_errors(known_blocks + information.blocks)
    cells = information.cells[(before > GOAL) & (after < (1.0 - IMPROVED) * before)]
    least, present = (1.0 - IMPROVED) ** 2, known.effects.get
    effects = [
        key
        for key, value in information.effects.items()
        if (present(key, 0.0) + value) * least > present(key, 0.0)
    ]
    return frozenset[int | Key]([*cells.tolist(), *effects])


def _share(information: Information, better: frozenset[int | Key], weights: FloatArray) -> float:
    """Share of what a segment visits, by weight, that it would still improve."""
    total = float(weights[information.cells].sum()) + EFFECT_WEIGHT * len(information.effects)
    gained = sum(weights[key] if isinstance(key, int) else EFFECT_WEIGHT for key in better)
    return float(gained / max(total, 1e-12))


def stitched(
    segments: Sequence[CandidateSegment], limits: Limits
) -> tuple[list[CandidateSegment], FloatArray, NDArray[np.intp]]:
    """One reference from segments in a row, the supply led over at rest; as many as fit.

    Segments that fit, the reference (n, 5) in SI, and the segment of each sample (n,).
    """
    parts, kept = list[FloatArray](), list[CandidateSegment]()
    free = round(limits.duration_s / STEP_S)
    for candidate in segments:
        row = candidate.segment.reference[:1]
        lead = row
        if parts:
            change = row[0, SUPPLY] - parts[-1][-1, SUPPLY]
            led = int(np.ceil(abs(change) / limits.supply_rate_paps / STEP_S)) + 1
            steps = max(round(REST_S / STEP_S), led)
            lead = np.repeat(row, steps, axis=0)
            lead[:, SUPPLY] = row[0, SUPPLY] - change * (1.0 - np.arange(1, steps + 1) / steps)
            lead[:, SHUT] = 0.0
        if len(lead) + len(candidate.segment.reference) > free:
            continue
        parts += [lead, candidate.segment.reference]
        kept.append(candidate)
        free -= len(lead) + len(candidate.segment.reference)
    lengths = [len(lead) + len(part) for lead, part in zip(parts[::2], parts[1::2], strict=True)]
    return kept, np.concatenate(parts), np.repeat(np.arange(len(kept)), lengths)


def checked(
    machine: DrivenMachine, limits: Limits, reference: FloatArray, chunk: FloatArray
) -> tuple[Extremes, ...]:
    """Extremes of a run, SI, beside limits; reference (n, 5), chunk (n, 2 + signals)."""
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
