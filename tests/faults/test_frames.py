"""Faults of the frames: lost, doubled, swapped, corrupted, from a second sender, not available."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_bridge import e2e
from firmware_bridge import frames as fr
from firmware_bridge.frames import Frames
from firmware_bridge.samples import GAP
from tests.faults.conftest import Figure
from tests.faults.harness import FRAMES_PER_CYCLE, at_s, drift, fault_free, machine, without

PA_BYTES = slice(2, 4)  # of Pressures


def cycles_without_all(lost: np.ndarray) -> int:
    """Runs of consecutive cycles of which a frame is missing: each must be one flagged gap."""
    broken = lost[: len(lost) // FRAMES_PER_CYCLE * FRAMES_PER_CYCLE].reshape(-1, FRAMES_PER_CYCLE)
    missing = broken.any(axis=1)
    return int((np.diff(np.concatenate([[False], missing]).astype(int)) == 1).sum())


@pytest.mark.parametrize(("share", "most"), [(0.01, 0.01), (0.10, 0.05)])
def test_row_1_random_loss(share: float, most: float, figure: Figure) -> None:
    frames = machine().frames
    lost = np.random.default_rng(1).random(len(frames)) < share
    lost[: 3 * FRAMES_PER_CYCLE] = lost[-3 * FRAMES_PER_CYCLE :] = False
    learner = machine().learned(without(frames, lost))
    gaps = learner.assembler.counters["gap"]
    figure(1, f"gaps not flagged at {share:.0%} loss", cycles_without_all(lost) - gaps, 0)
    figure(1, f"drift at {share:.0%} loss", drift(fault_free(), learner.estimator.solution()), most)


@pytest.mark.parametrize("n", [15, 16, 32, 256, 1000])
def test_row_2_bursts(n: int, figure: Figure) -> None:
    """Of every message n frames in a row, which a 4-bit counter does not see for n = 16."""
    frames, starts = machine().frames, range(3000, 55_000, 4000)
    lost = np.zeros(len(frames), bool)
    for start in starts:
        lost[FRAMES_PER_CYCLE * start : FRAMES_PER_CYCLE * (start + n)] = True
    learner = machine().learned(without(frames, lost))
    figure(2, f"bursts of {n} flagged", learner.assembler.counters["gap"] / len(starts),
           least=1.0, most=1.0)  # fmt: skip


@pytest.mark.parametrize("kind", ["duplicate", "swapped", "repeated later"])
def test_row_3_order(kind: str, figure: Figure) -> None:
    frames, rng = machine().frames, np.random.default_rng(3)
    order = np.arange(len(frames))
    chosen = np.sort(rng.choice(np.arange(300, len(frames) - 300), 300, replace=False))
    if kind == "swapped":  # with the same message of the next cycle
        chosen = chosen[np.diff(chosen, append=len(frames)) > 2 * FRAMES_PER_CYCLE]
        order[chosen], order[chosen + 3] = chosen + 3, chosen
    else:
        later = chosen + 1 if kind == "duplicate" else chosen + 30
        order = np.insert(order, later, chosen)
    learner = machine().learner()
    seen: list[float] = []
    for part in frames[order].chunks(3000):
        seen += learner.push(part)[:, 0].tolist()
    figure(3, f"samples used twice ({kind})", len(seen) - len(set(seen)), 0)
    figure(3, f"times that go back ({kind})", int((np.diff(seen) <= 0).sum()), 0)
    figure(3, f"drift ({kind})", drift(fault_free(), learner.estimator.solution()), 0.001)


def test_row_4_corrupted_payloads(figure: Figure) -> None:
    """Flipped bits behind a good bus CRC in more than half of all frames of 60 s."""
    frames, rng = machine().frames, np.random.default_rng(4)
    chosen = rng.choice(len(frames), 100_000, replace=False)
    data = frames.data.copy()
    for _ in range(3):  # one to three bits
        hit = chosen[rng.random(len(chosen)) < 0.75]
        data[hit, rng.integers(0, 8, len(hit))] ^= (1 << rng.integers(0, 8, len(hit))).astype("u1")
    wrong = (data != frames.data).any(axis=1)
    learner = machine().learned(replace(frames, data=data))
    passed = int(wrong.sum()) - learner.assembler.counters["crc"]
    figure(4, "corrupted frames that pass CRC-8", passed / int(wrong.sum()), 0.0045)


def test_row_4_drift_at_one_per_thousand(figure: Figure) -> None:
    """Random payloads, 1 frame in 1,000: the CRC lets 1 in 256 of these through."""
    frames, rng = machine().frames, np.random.default_rng(40)
    chosen = rng.choice(len(frames), len(frames) // 1000, replace=False)
    data = frames.data.copy()
    data[chosen] = rng.integers(0, 256, (len(chosen), 8), np.uint8)
    learner = machine().learned(replace(frames, data=data))
    figure(4, "drift, 1 random payload in 1,000",
           drift(fault_free(), learner.estimator.solution()), 0.005)  # fmt: skip


def test_row_5_second_sender(figure: Figure) -> None:
    """Between 20 and 30 s somebody else sends pressures of his own, with CRC and counter."""
    frames = machine().frames
    learner, alarm_s = machine().learner(), []
    for part in two_senders(frames, 20.0).chunks(30):
        learner.push(part)
        if learner.senders.doubted.any():
            alarm_s.append(float(part.t_us[-1] - frames.t_us[0]) * 1e-6)
    figure(5, "alarm after", alarm_s[0] - 20, 0.2, "s")
    figure(5, "learning again after", alarm_s[-1] - 30, 1.0, "s")


def test_row_5_a_second_sender_does_not_keep_the_first_ones_count(figure: Figure) -> None:
    """Before the alarm its frames are told by their counter: n steps take n periods."""
    frames = machine().frames[:75_000]
    learner, clean, taken = machine().learner(), machine().learner(), []
    for part in two_senders(frames, 20.0).chunks(30):
        taken.append(learner.push(part))
    expected = {row[0]: row[2:] for part in frames.chunks(3000) for row in clean.push(part)}
    wrong = sum((row[2:] != expected[row[0]]).any() for part in taken for row in part)
    figure(5, "samples with a value of the second sender", wrong, 0)


def two_senders(frames: Frames, begin_s: float) -> Frames:
    """For 10 s pressures come twice per cycle: good frames, half of them of another time."""
    t_s = at_s(frames)
    pressures = frames.can_id == machine().catalog.can_id("Pressures")
    other = frames[pressures & (t_s >= begin_s) & (t_s < begin_s + 10)]
    other.data[:] = np.roll(other.data, 5000, axis=0)
    other.t_us[:] += 400
    return fr.by_time(fr.concatenate([frames, other]))


@pytest.mark.parametrize("begin_s", [20.0, 40.0])
def test_row_5_drift(begin_s: float, figure: Figure) -> None:
    solution = machine().learned(two_senders(machine().frames, begin_s)).estimator.solution()
    figure(5, f"drift, from {begin_s:g} s on", drift(fault_free(), solution), 0.005)


@pytest.mark.parametrize("begin_s", [20.0, 40.0])
def test_row_6_drift(begin_s: float, figure: Figure) -> None:
    frames = frozen(machine().frames, begin_s, begin_s + 10)
    solution = machine().learned(frames).estimator.solution()
    figure(6, f"drift, from {begin_s:g} s on", drift(fault_free(), solution), 0.01)


def test_row_6_frozen_sensor(figure: Figure) -> None:
    """P_A holds for 10 s while the counter runs on."""
    learner, stopped_s, chunks = machine().learner(), [], []
    for part in frozen(machine().frames, 20.0, 30.0).chunks(30):
        chunk = learner.push(part)
        chunks.append(chunk[:, 0])
        if learner.frozen.doubted.any():
            stopped_s.append(float(part.t_us[-1] - machine().frames.t_us[0]) * 1e-6)
    used = np.concatenate(chunks)
    figure(6, "learning stops after", stopped_s[0] - 20, 1.0, "s")
    figure(6, "learning resumes after", float(used[used >= 30].min()) - 30, 1.0, "s")


def frozen(frames: Frames, begin_s: float, end_s: float) -> Frames:
    """The frames with P_A as it was at begin_s."""
    catalog, t_s = machine().catalog, at_s(frames)
    layouts = catalog.layouts("Pressures")
    chosen = np.flatnonzero((frames.can_id == catalog.can_id("Pressures")) & (t_s >= begin_s)
                            & (t_s < end_s))  # fmt: skip
    values = layouts.decode(frames.data[chosen])
    values[:, layouts.names.index("PA")] = values[0, layouts.names.index("PA")]
    return with_values(frames, "Pressures", chosen, values)


def with_values(
    frames: Frames, message: str, rows: np.ndarray, values: np.ndarray, full: bool = False
) -> Frames:
    """The frames with other values (rows, signals of the message) and right CRCs; full: PA too."""
    catalog = machine().catalog
    source, data = catalog.message_source(message), frames.data.copy()
    data[rows] = catalog.layouts(message).encode(values)
    if full:  # the converter at its end: all bits set
        data[rows, PA_BYTES] = 0xFF
    byte = catalog.byte_of(message, source.crc or "")
    length = catalog.message(message).length
    data[rows, byte] = e2e.crc8_bulk(data[rows], length, byte, source.data_id)
    return replace(frames, data=data)


@pytest.mark.parametrize("kind", ["not available", "saturated", "wrong length"])
def test_row_7_no_value(kind: str, figure: Figure) -> None:
    frames, catalog, rng = machine().frames, machine().catalog, np.random.default_rng(7)
    pressures = np.flatnonzero(frames.can_id == catalog.can_id("Pressures"))
    chosen = np.sort(rng.choice(pressures[100:-100], 2000, replace=False))
    if kind == "wrong length":
        length = frames.length.copy()
        length[chosen] = 7
        faulty = replace(frames, length=length)
    else:
        layouts = catalog.layouts("Pressures")
        values = layouts.decode(frames.data[chosen])
        column = layouts.names.index("PA")
        values[:, column] = np.nan if kind == "not available" else values[:, column]
        faulty = with_values(frames, "Pressures", chosen, values, kind == "saturated")
    learner = machine().learner()
    taken = np.concatenate([learner.push(part) for part in faulty.chunks(3000)])
    times = set(np.rint(taken[:, 0] * 1e3).astype(int).tolist())
    bad = set(np.rint(at_s(frames)[chosen] * 1e3 - 0.3).astype(int).tolist())
    figure(7, f"samples from such frames ({kind})", len(times & bad), 0)
    assert (taken[:, 1].astype(int) & GAP).sum() > 1500


def test_row_14_foreign_traffic(figure: Figure) -> None:
    """Four times as many frames of other identifiers change nothing, to the bit."""
    frames, rng = machine().frames, np.random.default_rng(14)
    part = frames[:30_000]
    n = 4 * len(part)
    foreign = fr.empty(n)
    foreign.t_us[:] = np.sort(rng.integers(part.t_us[0], part.t_us[-1], n))
    foreign.can_id[:] = rng.choice([0x7, 0x333, 0x7FF, 0x9FFF_0000], n)
    foreign.length[:], foreign.data[:] = 8, rng.integers(0, 256, (n, 8), np.uint8)
    quiet = machine().learned(part)
    flooded = machine().learned(fr.by_time(fr.concatenate([part, foreign])))
    same = quiet.estimator.state.memory.tobytes() == flooded.estimator.state.memory.tobytes()
    figure(14, "states that differ", 0 if same else 1, 0)
    assert flooded.assembler.counters["unknown_id"] == n
