"""The estimator: samples in, state on, solution out.  Knows no bus, no file and no clock.

Between updates, at fixed sample times, it keeps house (`model.Upkeep`): sums are taken out of the
kernels' memory into the current fold, the past fades by what news replace, and the map that is
held from now on judges the rows to come.
"""

from __future__ import annotations

from copy import deepcopy

import numpy as np

from firmware_bridge.samples import Samples
from rtid.estimator.blocks import VALID
from rtid.estimator.forgetting import faded, halved_surprise
from rtid.estimator.history import History
from rtid.estimator.solution import Solution, solve
from rtid.estimator.state import State, Weights, build
from rtid.estimator.sums import IntArray, Sums
from rtid.kernels.layout import TERMS
from rtid.model import FloatArray, Model


def to_chunk(model: Model, samples: Samples, origin_us: int) -> FloatArray:
    """The kernel's view of samples: (n, 2 + signals) = [s since origin_us, flags, values...].

    Raises KeyError if a signal of the model is missing among the samples.
    """
    missing = [s.name for s in model.signals if s.name not in samples.names]
    if missing:
        raise KeyError(f"the samples lack {', '.join(missing)}")
    chunk = np.empty((len(samples), 2 + len(model.signals)))
    chunk[:, 0] = (samples.t_us - origin_us) * 1e-6
    chunk[:, 1] = samples.flags
    chunk[:, 2:] = samples.values[:, [samples.names.index(s.name) for s in model.signals]]
    return chunk


class Estimator:
    """Learns all maps and compliances of a model together, sample by sample or trace by trace.

    The result does not depend on how the samples are cut into calls, bit for bit.
    """

    def __init__(self, model: Model, weights: Weights | None = None) -> None:
        self.model = model
        self.weights = weights
        self.reset()

    def reset(self) -> None:
        """Forget everything that was learned."""
        self.state: State = build(self.model, self.weights)
        self.origin_us: int | None = None
        self.folds = [Sums.of(self.state)] * self.model.upkeep.folds
        self.turns, upkeep = 0, self.model.upkeep
        self.history: History | None = None
        if upkeep.history_s > 0:
            rate, signals = upkeep.history_rows_per_s, len(self.model.signals)
            self.history = History(signals, upkeep.history_s, rate)

    def update(self, samples: Samples) -> None:
        """Take a run of samples in their order."""
        if len(samples) == 0:
            return
        if self.origin_us is None:
            self.origin_us = int(samples.t_us[0])
        self.advance(to_chunk(self.model, samples, self.origin_us))

    def advance(self, chunk: FloatArray) -> None:
        """Take samples in the kernel's view, with upkeep where it is due."""
        if self.history is not None:
            self.history.append(chunk)
        every_s = self.model.upkeep.every_s
        if every_s <= 0:
            self.state.advance(chunk)
            return
        turns = np.floor(chunk[:, 0] / every_s)
        while len(chunk):
            due = turns > self.turns
            count = int(np.argmax(due)) if due.any() else len(chunk)
            self.state.advance(chunk[:count])
            chunk, turns = chunk[count:], turns[count:]
            if len(chunk):
                self._keep_house(int(turns[0]))

    def _keep_house(self, turn: int) -> None:
        """End one turn; what no sample fell into is skipped."""
        upkeep, fold = self.model.upkeep, self.turns % self.model.upkeep.folds
        news = Sums.drained(self.state)
        passed_s = (turn - self.turns) * upkeep.every_s
        self.turns = turn
        if np.isfinite(min(upkeep.forget_s, upkeep.shared_forget_s)):
            self._fade(news, passed_s)
        self.folds[fold] = self.folds[fold] + news
        if upkeep.innovation_sd > 0:
            self._hold()

    def _fade(self, news: Sums, passed_s: float) -> None:
        upkeep, changed = self.model.upkeep, self._changed(news)
        share = -np.expm1(-passed_s / upkeep.forget_s)
        shared = -np.expm1(-passed_s / upkeep.shared_forget_s)
        self.folds = [
            faded(halved_surprise(past), news, share, shared, changed) for past in self.folds
        ]

    def _changed(self, news: Sums) -> IntArray:
        """Cells whose new rows contradict the map held."""
        blocks, gates = news.blocks, self.model.gates
        enough = blocks["judged"] >= gates.min_rows
        return news.cells[enough & (blocks["surprise"] > gates.max_surprise * blocks["judged"])]

    def _hold(self) -> None:
        """Let the valid part of the present map judge the rows to come."""
        solution, cells = self.solution(), self.state.cells.copy()
        status = np.array([block.status for block in solution.blocks])
        terms = solution.unknowns[len(solution.unknowns) - TERMS * len(status) :]
        cells["held"][solution.cells] = terms.reshape(-1, TERMS)
        cells["known"][solution.cells] = status == VALID
        shared = len(solution.scale_pa)
        known = solution.unknowns[: shared + len(solution.terms)]
        compliance, coefficients = np.split(known, [shared])
        self.state.hold(cells, compliance, coefficients)
        self.state.engine[0]["gate_sd"] = self.model.upkeep.innovation_sd
        self.state.engine[0]["gate_rows"] = self.model.upkeep.innovation_rows

    @property
    def sums(self) -> Sums:
        """Everything that counts by now: all folds, and what was learned since the last upkeep."""
        total = Sums.of(self.state)
        for fold in self.folds:
            total = fold + total if len(fold.blocks) else total
        return total

    @property
    def counters(self) -> dict[str, int]:
        """Samples, rows, and how often a sample was refused or a memory restarted, by reason."""
        return self.state.counters

    def solution(self) -> Solution:
        """The joint estimate from everything seen so far; nothing is changed by asking."""
        return solve(self.model, self.sums, float(self.state.engine[0]["t_s"]), self.counters)

    def copy(self) -> Estimator:
        """An independent estimator that continues bit for bit like this one."""
        twin = Estimator.__new__(Estimator)
        twin.model, twin.weights = self.model, self.weights
        twin.state, twin.origin_us = self.state.copy(), self.origin_us
        twin.folds, twin.turns = list(self.folds), self.turns
        twin.history = deepcopy(self.history)
        return twin
