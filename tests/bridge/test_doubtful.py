"""Second senders and frozen sensors: whatever the pieces, the same is refused."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler
from firmware_bridge.frames import Frames
from firmware_bridge.frozen import Frozen, run_limit
from firmware_bridge.samples import GAP, ROW, Samples
from firmware_bridge.senders import Senders
from tests.bridge.machine import CATALOG, assembly, cycles


def senders() -> Senders:
    return Senders(Assembler(CATALOG, assembly()).declared)


def doubled(frames: Frames, begin: int, end: int) -> Frames:
    other = frames[(np.arange(len(frames)) >= begin) & (np.arange(len(frames)) < end)]
    other.t_us[:] += 350
    return fr.by_time(fr.concatenate([frames, other]))


@pytest.mark.parametrize("size", [1, 7, 4096])
def test_pieces_make_no_difference(size: int) -> None:
    both, gate = doubled(cycles(2000), 1500, 3000), senders()
    kept = fr.concatenate([gate.push(part) for part in both.chunks(size)])
    whole = senders().push(both)
    assert (kept.t_us == whole.t_us).all()
    assert kept.refused == whole.refused == {"too_fast": len(both) - len(whole)}


def test_jitter_a_stall_and_what_it_owed_are_no_second_sender() -> None:
    """Frames held up for 0.3 s and then sent at once."""
    frames = cycles(3000)
    held = (frames.t_us > frames.t_us[3000]) & (frames.t_us < frames.t_us[3000] + 300_000)
    frames.t_us[held] = frames.t_us[3000] + 300_000 + np.arange(held.sum())
    assert len(senders().push(frames)) == len(frames)


def test_a_clock_that_is_set_back_does_not_refuse_for_ever() -> None:
    gate, frames = senders(), cycles(4000)
    gate.push(doubled(frames[:3000], 1500, 3000))
    later = frames[6000:]
    later.t_us[:] -= 3_600_000_000
    kept = gate.push(later)
    assert len(kept) > 0.9 * len(later)


def samples(n: int, seed: int = 0) -> Samples:
    rng = np.random.default_rng(seed)
    values = np.rint(rng.normal(0, 5.0, (n, 2)))
    values[200:260, 1] = values[200, 1]
    return Samples(("a", "b"), np.arange(n), values, np.full(n, ROW, np.uint8))


@pytest.mark.parametrize("size", [1, 7, 4096])
def test_a_frozen_signal_is_refused_until_it_moves(size: int) -> None:
    limit = run_limit(5.0, 1.0)
    gate, whole = Frozen([limit, limit]), samples(400)
    kept = [gate.push(whole.between(k * 1e-6, (k + size) * 1e-6)) for k in range(0, 400, size)]
    times = np.concatenate([part.t_us for part in kept])
    flags = np.concatenate([part.flags for part in kept])
    assert set(range(400)) - set(times.tolist()) == set(range(200 + limit, 260))
    assert flags[times == 260] & GAP and not flags[times == 261] & GAP
    assert gate.refused == 60 - limit


def test_a_quiet_sensor_is_not_judged() -> None:
    assert run_limit(0.0, 1.0) == run_limit(0.3, 1.0) == 0
    assert run_limit(5.0, 0.0) > 0
    gate = Frozen([0, 0])
    steady = Samples(("a", "b"), np.arange(999), np.ones((999, 2)), np.full(999, ROW, np.uint8))
    assert len(gate.push(steady)) == 999


def test_noise_never_looks_frozen() -> None:
    """A million readings whose noise is half a step."""
    rng = np.random.default_rng(1)
    values = np.rint(rng.normal(0.25, 0.5, (1_000_000, 1)))
    gate = Frozen([run_limit(0.5, 1.0)])
    many = Samples(("a",), np.arange(len(values)), values, np.full(len(values), ROW, np.uint8))
    assert len(gate.push(many)) == len(values)
