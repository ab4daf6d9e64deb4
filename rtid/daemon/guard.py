"""The guard of the good map: what was published must foretell the motion before anything counts.

The baseline is a map that was published or accepted, with the level of what it leaves on the
healthy machine.  After a start it has to foretell PROOF_S seconds of motion within that level;
then it is held against the motion all the time (`rtid.compare.foretelling`).  What it does not know
proves nothing: there the samples must move as declared (`rtid.daemon.first`), and the machine must
not keep out of all that it knows.  Slow wear is carried over to it (`rtid.daemon.wearing`).

What goes on being published after a kill need not be proven: it must not hold a fault that matters.
A second with a mean square s above 2 log(4) / 1.5 = 1.85 lets the sum of the test rise, so TRUST
seconds behind which it is zero have shown no fault of twice sigma; a smaller one, of a share r of
the flow, learned for n of T seconds, moves the map by r n / T: 1 % in 10 of 100 s by a thousandth.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from rtid.compare import CandidateMap
from rtid.compare.foretelling import (
    COMMON,
    WARM_S,
    Residuals,
    Seconds,
    in_motion,
    level_of,
    moving,
    rated_m3s,
    residuals,
    seconds,
    sigma_m3s,
)
from rtid.compare.suspects import MOST_S, LikelyCause, causes
from rtid.daemon.first import follows_command, wrong_signs
from rtid.estimator.flowmap import FlowMap
from rtid.estimator.solution import Solution
from rtid.estimator.state import nominal_weights
from rtid.estimator.wear import Wear
from rtid.model import Machine
from rtid.plain import FloatArray

PIECE_S = 2.0  # of samples that are judged at once
KEPT = 60  # seconds of motion that are looked back on
PROOF = 20  # ... that must have been foretold
TRUST = 4  # ... behind a snapshot that goes on being published after a kill
ENOUGH = 60  # ... after which a map that is not known there must not hold up the learning
LEVEL = 30  # ... that make a level
SURE = 10  # ... among the newest samples that must move as declared
AGAIN = 10  # ... of a contradiction without a cause, until causes are looked for again
GAP_S = 0.1  # between two of them
LEAST_SHARE = 0.2  # of the share of motion that the map knew where it was learned
COUNTED = 30  # pieces that this share is counted over
UNKNOWN = 0.01  # level of a map that has none yet, share of the rated flow

State = Literal["proving", "proven", "contradicted"]


def candidate_of(solution: Solution, flow_map: FlowMap) -> CandidateMap:
    """What is published, to be held against samples."""
    status = np.concatenate([edge.status.ravel() for edge in flow_map.edges])
    model = solution.model
    weights, theta = nominal_weights(model), flow_map.theta_cells()
    return CandidateMap("", theta, solution.compliance, status, weights, solution.terms_theta)


def with_wear(model: Machine, candidate: CandidateMap, wear: Wear) -> CandidateMap:
    """The map of a machine that has changed so."""
    gains = [g for g, e in zip(wear.gain, model.edges, strict=True) if not e.shares]
    cells = [e.grid.shape[0] * e.grid.shape[1] for e in model.maps]
    theta = (1.0 + np.repeat(gains, cells)[:, None]) * candidate.theta
    return replace(candidate, theta=theta, terms=candidate.terms + wear.terms)


class Guard:
    """One baseline beside the samples.

    level (chambers,): m3/s, stored with the baseline; None: to be measured first.  usual_share: of
    the rows in motion that the map knew where it was learned, stored as well.
    """

    def __init__(
        self,
        model: Machine,
        candidate: CandidateMap,
        level: FloatArray | None,
        state: State,
        usual_share: float = 0.0,
    ) -> None:
        self._model, self._candidate = model, candidate
        self.level, self.state, self._usual_share = level, state, usual_share
        self.worn = np.zeros(len(model.edges))  # change of gain that was carried over, relative
        self.since_s = 0.0  # sample time at which the contradiction began
        self.against: tuple[str, ...] = ()  # what speaks against the samples themselves
        self._alarm_s, self._due = 0.0, 0  # of the contradiction; `_moved` to look for causes again
        self._is_sure = False  # there is motion enough for that
        self.has_foretold = False  # and was not merely known too little
        self.moved = 0  # seconds of motion since the beginning
        self._moved_s = -math.inf  # the newest of them: a piece may end within it
        self._counts: deque[tuple[int, int]] = deque(maxlen=COUNTED)  # rows in motion, known ones
        self._rows: Residuals | None = None
        self._weighed: tuple[Residuals, FloatArray | None, Seconds] | None = None  # `_window`
        self._pieces: list[FloatArray] = []
        self._recent: list[FloatArray] = []  # samples for the causes

    def foretells(self, candidate: CandidateMap, chunk: FloatArray) -> bool:
        """Whether another map foretells samples (n, 2 + signals), SI, that it has not learned, too.

        One of two oils has one compliance for both, and flows between theirs: it may not.
        """
        rows = in_motion(self._model, residuals(self._model, candidate, chunk))
        judged = seconds(self._model, rows, self._level)
        return judged.foretold and not judged.contradicts

    def follow(self, candidate: CandidateMap) -> None:
        """Another map, which has foretold the motion as well, takes the place of the baseline.

        What the first maps have left goes on to count: they are known for a few places only, and a
        level of them is too large rather than too small.
        """
        self._candidate = candidate
        self.has_foretold = True
        if self.level is not None:
            self.level = self._measured() if self._can_measure() else self.level
            self._rows = None

    def carry_over(self, wear: Wear) -> None:
        """The machine that the baseline was learned of has changed slowly: so has the baseline."""
        self._candidate = with_wear(self._model, self._candidate, wear)
        self.worn = (1.0 + self.worn) * (1.0 + wear.gain) - 1.0

    def push(self, chunk: FloatArray) -> bool:
        """Take samples (n, 2 + signals), SI; whether the state has changed."""
        if not len(chunk):
            return False
        if self._pieces and chunk[0, 0] < self._pieces[-1][-1, 0]:  # the clock was set
            self._pieces, self._recent, self._rows = [], [], None
            self._moved_s = -math.inf
        self._pieces.append(chunk)
        first_s, last_s = self._pieces[0][0, 0], chunk[-1, 0]
        if last_s - first_s < PIECE_S + WARM_S:
            return False
        piece = np.concatenate(self._pieces)
        self._pieces = [piece[piece[:, 0] >= last_s - WARM_S]]
        self._recent.append(piece[piece[:, 0] >= first_s + WARM_S])
        while len(self._recent) > 1 and self._recent[1][0, 0] < last_s - MOST_S:
            del self._recent[0]
        return self._judge(piece)

    @property
    def progress(self) -> dict[str, Any]:
        """How far the proof has come, for JSON: another process goes on from there."""
        rows = self._rows
        parts = {} if rows is None else {name: part.tolist() for name, part in vars(rows).items()}
        counts = [list(count) for count in self._counts]
        return {"moved": self.moved, "counts": counts, "rows": parts}

    def resume(self, progress: Mapping[str, Any]) -> None:
        """Go on with the `progress` of a process that was ended; times are those of its samples."""
        self.moved = int(progress["moved"])
        self._counts.extend((int(moved), int(known)) for moved, known in progress["counts"])
        parts, c = progress["rows"], len(self._model.chambers)
        if parts and np.shape(parts["columns"])[1:] == (c, c + COMMON):  # of this program, and any
            self._rows = Residuals(**{name: np.array(part) for name, part in parts.items()})

    def causes(self) -> list[LikelyCause]:
        """What would mend the map, of the newest samples."""
        return self._causes(self.since_s)

    def later_causes(self) -> list[LikelyCause] | None:
        """The same of samples that came behind the contradiction alone; None: not yet known.

        A suspicion may begin before the fault: healthy samples hide what would mend the others, or
        mend something else with a few seconds of them.
        """
        if self.state != "contradicted" or self.moved < self._due:
            return None
        self._due = self.moved + AGAIN
        return self._causes(self._alarm_s)

    def _causes(self, since_s: float) -> list[LikelyCause]:
        recent = np.concatenate(self._recent)
        chunk = recent[recent[:, 0] >= since_s - WARM_S]
        return causes(self._model, self._candidate, chunk, self._level)

    @property
    def has_seen_much(self) -> bool:
        """Whether there was motion enough to be proven or contradicted by."""
        return self.moved >= ENOUGH

    @property
    def is_lost(self) -> bool:
        """Whether it can say nothing of all that motion, for it or against it."""
        return self.state == "proving" and self.has_seen_much and not self._window().cusum[0]

    def is_calm_behind(self, t_s: float, n: int) -> bool:
        """Whether so many seconds of motion behind a time speak in no way against the baseline."""
        if self.state != "proven":
            return False
        window = self._window()
        return window.cusum[0] == 0.0 and int((window.t_s >= t_s).sum()) >= n

    def answers_for(self, t_s: float, n: int) -> bool:
        """Whether what so many seconds of motion behind a time mean is the baseline's to say.

        It knows what a healthy day may change, and what matters.  One without a level can only say
        that it does not mind.
        """
        if self.level is None:
            return self.is_calm_behind(t_s, n)
        return self.state == "proven" and int((self._window().t_s >= t_s).sum()) >= n

    @property
    def known_share(self) -> float:
        """Share of the newest rows in motion that the map is known for."""
        moved, known = np.sum([*self._counts, (0, 0)], axis=0)
        return float(known) / float(moved) if moved else 0.0

    @property
    def _level(self) -> FloatArray:
        unknown = np.full(len(self._model.chambers), UNKNOWN * rated_m3s(self._model))
        return unknown if self.level is None else self.level

    def _judge(self, piece: FloatArray) -> bool:
        every = moving(self._model, residuals(self._model, self._candidate, piece))
        second = np.unique(np.floor(every.t_s))
        self.moved += int((second > self._moved_s).sum())
        self._moved_s = max([self._moved_s, *second])
        self._counts.append((len(every.t_s), int(every.known.sum())))
        recent = self.newest
        moved = sum(count > 0 for count, _ in [*self._counts][-len(self._recent) :])
        self._is_sure = min(moved * PIECE_S, recent[-1, 0] - recent[0, 0]) >= SURE
        self.against = wrong_signs(self._model, recent) if self._is_sure else ()
        rows = in_motion(self._model, every)
        self._rows = rows if self._rows is None else self._rows + rows
        window = self._window()
        if len(window.t_s) > KEPT:
            self._rows = self._rows.since(window.t_s[-KEPT])
        if self.level is None and self.state == "proven" and self._can_measure():
            self.level = self._measured()
        return self._decide(window)

    @property
    def newest(self) -> FloatArray:
        """Samples (n, 2 + signals), SI, behind the last gap: what moved in it had no command."""
        recent = np.concatenate(self._recent)
        gaps = np.flatnonzero(np.diff(recent[:, 0]) > GAP_S)
        return recent[gaps[-1] + 1 :] if len(gaps) else recent

    def _decide(self, window: Seconds) -> bool:
        if self.state != "contradicted":
            is_judge = self.level is not None or self.state == "proving"
            if self.against or (is_judge and window.contradicts):
                rises = window.cusum[0] > 0.0
                self.since_s = window.cusum[1] if rises else self._disobeys_since_s()
                self.state = "contradicted"
                self._alarm_s, self._due = float(self._recent[-1][-1, 0]), self.moved + AGAIN
                self._rows = None  # a way back needs new motion
                return True
            if self.state == "proven":
                return False
        is_enough = len(window.t_s) >= PROOF and window.foretold
        is_proof = is_enough or (self.state == "proving" and self._is_elsewhere(window))
        if window.cusum[0] > 0.0 or self.against or not is_proof:
            return False
        self.state, self.has_foretold = "proven", is_enough
        return True

    def _disobeys_since_s(self) -> float:
        """Begin of the newest samples, without which the machine follows its command."""
        pairs = [*pairwise(self._recent)]
        obeys = [follows_command(self._model, np.concatenate(pair)) for pair in pairs]
        if not any(obeys) or obeys[-1]:  # what is wrong is not the command's sign
            return float(self._recent[0][0, 0])
        last = max(k for k, does in enumerate(obeys) if does)
        return float(pairs[last][1][0, 0])

    def _is_elsewhere(self, window: Seconds) -> bool:
        """Whether the machine works where the map knows little, as a healthy one may.

        One whose command is reversed keeps out of nearly all that was ever visited.
        """
        usual = self.known_share >= LEAST_SHARE * self._usual_share
        return self._is_sure and self.has_seen_much and len(window.t_s) < PROOF and usual

    def _window(self) -> Seconds:
        rows, level = self._rows, self.level
        if rows is None:
            return Seconds(np.empty(0), np.empty((0, len(self._model.chambers))))
        if self._weighed is None or self._weighed[0] is not rows or self._weighed[1] is not level:
            self._weighed = rows, level, seconds(self._model, rows, self._level)
        return self._weighed[2]

    def _can_measure(self) -> bool:
        return len(self._window().t_s) >= LEVEL

    def _measured(self) -> FloatArray:
        return level_of(self._window(), sigma_m3s(self._model, self._level))
