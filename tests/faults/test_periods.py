"""Row 36: periods of any length against any stamps: none is lost, none repeated, nothing spins."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtid.daemon.core import Core
from rtid.estimator import estimator as estimators
from rtid.estimator.estimator import Estimator
from rtid.estimator.sums import Sums
from rtid.plain import FloatArray
from tests.faults.conftest import Figure
from tests.faults.harness import machine

PERIODS, STAMPS = 1000, 1000


def stamps_s(rng: np.random.Generator) -> FloatArray:
    """Times that go on by microseconds to days, repeat, and step back now and then."""
    steps = 10.0 ** rng.uniform(-6.0, rng.uniform(-5.0, 5.0), STAMPS)
    steps *= rng.choice([1.0, 0.0, -1.0], STAMPS, p=[0.94, 0.04, 0.02])
    return np.asarray(1e-6 * np.maximum(0, np.rint(1e6 * np.cumsum(steps))))


def due_at(t_us: list[int], every_us: int) -> list[int]:
    """Rows at which a period ends, by its definition."""
    rows, begin = list[int](), None
    for k, now in enumerate(t_us):
        if begin is None or now >= begin + every_us or now < begin:
            rows.append(k)
            begin = now
    return rows


def kept_house(
    every_s: float, t_s: FloatArray, monkeypatch: pytest.MonkeyPatch
) -> tuple[list[int], Estimator]:
    """The times of upkeep in us, learning and upkeep themselves left out."""
    model, times = machine().project.model, list[int]()
    estimator = Estimator(replace(model, upkeep=replace(model.upkeep, every_s=every_s)))
    real = estimator._keep_house
    estimator.folds = [0] * len(estimator.folds)  # type: ignore[list-item]
    for name in ("_changed", "_fade"):
        monkeypatch.setattr(Estimator, name, lambda *_: None)
    monkeypatch.setattr(Sums, "drained", lambda _: 0)
    monkeypatch.setattr(estimators, "without_surprise", lambda *_: 0)
    monkeypatch.setattr(type(estimator.state), "advance", lambda *_: None)

    def noted(_: Estimator, now_us: int) -> None:
        times.append(now_us)
        real(now_us)

    monkeypatch.setattr(Estimator, "_keep_house", noted)
    estimator.history = None
    chunk = np.zeros((len(t_s), 2 + len(model.signals)))
    chunk[:, 0] = t_s
    for piece in np.array_split(chunk, 4):  # as it may arrive
        estimator._advance(piece)
    return times, estimator


@pytest.mark.faults
def test_row_36_upkeep(figure: Figure, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, wrong = np.random.default_rng(36), 0
    for _ in range(PERIODS):
        t_s, every_s = stamps_s(rng), float(10.0 ** rng.uniform(-6.0, 6.0))
        with monkeypatch.context() as patched:
            times, estimator = kept_house(every_s, t_s, patched)
        t_us = [round(1e6 * t) for t in t_s.tolist()]
        expected = [t_us[k] for k in due_at(t_us, max(1, round(1e6 * every_s)))]
        wrong += times != expected or estimator.turns != len(expected)
    figure(
        36, f"periods of upkeep of {PERIODS} lost or repeated over {STAMPS} stamps each", wrong, 0
    )


@pytest.mark.faults
def test_row_36_handovers(figure: Figure) -> None:
    """Publishing and storing: each due one once, and at most one in a tick.

    The next save begins earlier by what the last one took, half a second at least, but by half of
    its period at most.
    """
    rng, wrong = np.random.default_rng(37), 0
    for _ in range(PERIODS):
        publish_ns, store_ns = (round(1e9 * 10.0 ** rng.uniform(-6.0, 5.0)) for _ in range(2))
        save_s = 10.0 ** rng.uniform(-6.0, 5.0)
        early_ns = max(round(1e9 * save_s), 500_000_000)
        after_ns = (publish_ns, max(store_ns - early_ns, store_ns - store_ns // 2))
        now_ns = np.cumsum(np.rint(1e9 * 10.0 ** rng.uniform(-4.0, 1.0, STAMPS))).astype(int)
        done: list[tuple[bool, bool]] = []
        core: Any = SimpleNamespace(
            is_solving=False, is_saving=False, samples=1, is_proving=False, save_s=save_s,
            _publish_ns=publish_ns, _store_ns=store_ns, _due_publish_ns=publish_ns,
            _due_store_ns=store_ns,
            hand_over=lambda publish, store, done=done: done.append((publish, store)),
        )  # fmt: skip
        due = [publish_ns, store_ns]
        for now in now_ns.tolist():
            expected = tuple(now >= end for end in due)
            due = [now + every if is_due else end for is_due, end, every in
                   zip(expected, due, after_ns, strict=True)]  # fmt: skip
            done.clear()
            Core._hand_over_if_due(core, now)
            wrong += done != ([expected] if any(expected) else [])
    figure(36, f"ticks of {PERIODS * STAMPS:.0e} with a wrong handover", wrong, 0)
