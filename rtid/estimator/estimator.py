"""The estimator: samples in, state on, solution out.  Knows no bus, no file and no clock.

Between updates, at fixed sample times, it keeps house (`model.Upkeep`): sums are taken out of the
kernels' memory into the current fold, the past fades by what news replace, and the map that is
held from now on judges the rows to come.
"""

from __future__ import annotations

from copy import deepcopy

import numpy as np

from firmware_bridge.samples import Samples
from rtid.errors import require
from rtid.estimator.blocks import VALID
from rtid.estimator.chunk import to_chunk
from rtid.estimator.factor import one_thread
from rtid.estimator.forgetting import faded, halved_surprise, without_surprise
from rtid.estimator.ring import History
from rtid.estimator.solution import Solution, solve
from rtid.estimator.state import State, Weights, build, tell_unmarked
from rtid.estimator.sums import Sums
from rtid.estimator.walking import gain_of, walked
from rtid.estimator.wear import Wear, carried_over
from rtid.kernels.layout import TERMS
from rtid.model import Machine
from rtid.plain import BoolArray, FloatArray, IntArray

KNOWN = 0.05  # relative sd of the compliances up to which a map may judge rows
AT_ONCE = 4096  # rows that are looked through for the next upkeep
NO_STAMP_US = 2.0**53  # a time that is no number, or beyond whole microseconds in a float


def stamps_us(chunk: FloatArray) -> tuple[IntArray, BoolArray]:
    """The time of each row in whole microseconds (n,), and whether it is one at all.

    Times are compared as whole numbers: of seconds, (t - period) + period may be another stamp.
    """
    t_us = np.rint(1e6 * chunk[:, 0])
    known = np.abs(t_us) < NO_STAMP_US
    return np.where(known, t_us, 0.0).astype(np.int64), known


class Estimator:
    """Learns all maps and compliances of a model together, sample by sample or trace by trace.

    The result does not depend on how the samples are cut into calls, bit for bit.
    """

    def __init__(self, model: Machine, weights: Weights | None = None) -> None:
        self.model = model
        self.weights = weights
        self.reset()

    def reset(self) -> None:
        """Forget everything that was learned."""
        self.state: State = build(self.model, self.weights)
        self.origin_us: int | None = None
        self.folds = [Sums.of(self.state)] * self.model.upkeep.folds
        self.turns, upkeep = 0, self.model.upkeep
        self.due_us: int | None = None  # time of the next upkeep, as in `to_chunk`; None: at once
        self.history: History | None = None
        if upkeep.history_s > 0:
            rate, signals = upkeep.history_rows_per_s, len(self.model.signals)
            self.history = History(signals, upkeep.history_s, rate)

    def update(self, samples: Samples) -> None:
        """Take a run of samples in their order."""
        require("update", "samples", samples, Samples)
        if len(samples) == 0:
            return
        tell_unmarked(samples.flags)
        if self.origin_us is None:
            self.origin_us = int(samples.t_us[0])
        self.advance(to_chunk(self.model, samples, self.origin_us))

    def advance(self, chunk: FloatArray) -> None:
        """Take samples (n, 2 + signals) in the kernel's view, SI, with upkeep where it is due."""
        if self.history is not None:
            self.history.append(chunk)
        for k in range(0, len(chunk), AT_ONCE):
            self._advance(chunk[k : k + AT_ONCE])

    def _advance(self, chunk: FloatArray) -> None:
        """Take a few rows: each upkeep looks through those that are left."""
        while (count := self._until_due(chunk)) < len(chunk):
            self.state.advance(chunk[:count])
            chunk = chunk[count:]
            self._keep_house(int(stamps_us(chunk[:1])[0][0]))
        self.state.advance(chunk)

    @property
    def _every_us(self) -> int:
        """The period of upkeep, at least a microsecond: so the row at which it came is not due."""
        return max(1, round(1e6 * self.model.upkeep.every_s))

    def _until_due(self, chunk: FloatArray) -> int:
        """How many rows come before the next upkeep; a clock that steps back calls for one too."""
        if self.model.upkeep.every_s <= 0:
            return len(chunk)
        t_us, due = stamps_us(chunk)
        if self.due_us is not None:
            due &= (t_us >= self.due_us) | (t_us < self.due_us - self._every_us)
        return int(np.argmax(due)) if due.any() else len(chunk)

    def _keep_house(self, now_us: int) -> None:
        """End one turn; a clock that jumps ends it too, and the next one begins at the new time."""
        upkeep, fold = self.model.upkeep, self.turns % self.model.upkeep.folds
        self.due_us = now_us + self._every_us
        self.turns += 1
        news = Sums.drained(self.state)
        with one_thread():
            changed = self._changed(news)
            self._fade(news, changed)
            self._walk(news)
        self.folds[fold] = self.folds[fold] + without_surprise(news, changed)
        if upkeep.innovation_sd > 0:
            self.hold(self.solution())

    def _fade(self, news: Sums, changed: IntArray) -> None:
        """Let the past give up what the news replace, and what they contradict."""
        upkeep = self.model.upkeep
        share = -float(np.expm1(-upkeep.every_s / upkeep.forget_s))
        shared = -float(np.expm1(-upkeep.every_s / upkeep.shared_forget_s))
        if not upkeep.fades:
            return
        self.folds = [
            faded(halved_surprise(past), news, share, shared, changed) for past in self.folds
        ]

    def _walk(self, news: Sums) -> None:
        """Let the past know less of the gain of all maps, which has gone on since."""
        upkeep = self.model.upkeep
        if upkeep.gain_walk <= 0.0:
            return
        total = sum(self.folds, news)
        gain, variance = gain_of(self.model, total), upkeep.gain_walk**2 * upkeep.every_s
        self.folds = [walked(past, news, gain, variance) for past in self.folds]

    def carry_over(self, wear: Wear) -> None:
        """Go on as if all had been learned of a machine that has changed so."""
        fold, news = self.turns % self.model.upkeep.folds, Sums.drained(self.state)
        self.folds[fold] = self.folds[fold] + news
        self.folds = [carried_over(past, wear) for past in self.folds]

    def _changed(self, news: Sums) -> IntArray:
        """Cells whose new rows contradict the map held."""
        blocks, gates = news.blocks, self.model.gates
        enough = blocks["judged"] >= gates.min_rows
        return news.cells[enough & (blocks["surprise"] > gates.max_surprise * blocks["judged"])]

    def hold(self, solution: Solution) -> bool:
        """Let the valid part of a map judge the rows to come; False while beta is not known."""
        engine = self.state.engine[0]
        pressures = np.array([bool(c.pressure) for c in self.model.chambers])
        uncertain = np.sqrt(np.diag(solution.compliance_cov)) > KNOWN * solution.compliance
        if (uncertain & pressures).any():
            engine["gate_sd"] = 0.0
            return False
        n_c, m = len(solution.scale_pa), len(solution.terms)
        valid = np.array([block.status == VALID for block in solution.blocks], bool)
        theta = solution.unknowns[n_c + m :].reshape(-1, TERMS)
        compliance, terms = solution.unknowns[:n_c], solution.unknowns[n_c : n_c + m]
        cells, cov = solution.cells[valid], solution.cell_cov[valid]
        self.state.hold(cells, theta[valid], cov, compliance, terms)
        engine["gate_sd"] = self.model.upkeep.innovation_sd
        engine["admits_all"] = 0
        engine["gate_rows"] = self.model.upkeep.innovation_rows
        return True

    @property
    def sums(self) -> Sums:
        """Everything that counts by now: all folds, and what was learned since the last upkeep."""
        total = Sums.of(self.state)
        for fold in self.folds:
            total = fold + total
        return total

    @property
    def counters(self) -> dict[str, int]:
        """Samples, rows, and how often a sample was refused or a memory restarted, by reason."""
        return self.state.counters

    def solution(self) -> Solution:
        """The joint estimate from everything seen so far; nothing is changed by asking."""
        return solve(self.model, self.sums, float(self.state.engine[0]["t_s"]), self.counters)

    def copy(self, with_history: bool = True) -> Estimator:
        """An independent estimator that continues bit for bit like this one."""
        twin = Estimator.__new__(Estimator)
        twin.model, twin.weights = self.model, self.weights
        twin.state, twin.origin_us = self.state.copy(), self.origin_us
        twin.folds, twin.turns, twin.due_us = list(self.folds), self.turns, self.due_us
        twin.history = deepcopy(self.history) if with_history else None
        return twin
