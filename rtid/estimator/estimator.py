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
from rtid.estimator.factor import one_thread
from rtid.estimator.forgetting import faded, halved_surprise, without_surprise
from rtid.estimator.history import History
from rtid.estimator.solution import Solution, solve
from rtid.estimator.state import State, Weights, build
from rtid.estimator.sums import IntArray, Sums
from rtid.kernels.layout import TERMS
from rtid.model import FloatArray, Model

KNOWN = 0.05  # relative sd of the compliances up to which a map may judge rows


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
        self.turns, self.due_s, upkeep = 0, -np.inf, self.model.upkeep
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
        while every_s > 0 and len(chunk):
            t_s = chunk[:, 0]
            due = (t_s >= self.due_s) | (t_s < self.due_s - every_s)
            count = int(np.argmax(due)) if due.any() else len(chunk)
            self.state.advance(chunk[:count])
            chunk = chunk[count:]
            if len(chunk):
                self._keep_house(float(chunk[0, 0]))
        self.state.advance(chunk)

    def _keep_house(self, now_s: float) -> None:
        """End one turn; a clock that jumps ends it too, and the next one begins at the new time."""
        upkeep, fold = self.model.upkeep, self.turns % self.model.upkeep.folds
        self.due_s = now_s + upkeep.every_s if np.isfinite(now_s) else self.due_s
        self.turns += 1
        news = Sums.drained(self.state)
        with one_thread():
            changed = self._changed(news)
            self._fade(news, changed)
        self.folds[fold] = self.folds[fold] + without_surprise(news, changed)
        if upkeep.innovation_sd > 0:
            self.hold(self.solution())

    def _fade(self, news: Sums, changed: IntArray) -> None:
        """Let the past give up what the news replace, and what they contradict."""
        upkeep = self.model.upkeep
        share = -float(np.expm1(-upkeep.every_s / upkeep.forget_s))
        shared = -float(np.expm1(-upkeep.every_s / upkeep.shared_forget_s))
        if not (share or shared or upkeep.innovation_sd):
            return
        self.folds = [
            faded(halved_surprise(past), news, share, shared, changed) for past in self.folds
        ]

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

    def copy(self) -> Estimator:
        """An independent estimator that continues bit for bit like this one."""
        twin = Estimator.__new__(Estimator)
        twin.model, twin.weights = self.model, self.weights
        twin.state, twin.origin_us = self.state.copy(), self.origin_us
        twin.folds, twin.turns, twin.due_s = list(self.folds), self.turns, self.due_s
        twin.history = deepcopy(self.history)
        return twin
