from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler, AssemblyError
from firmware_bridge.catalog import CatalogError
from firmware_bridge.config import Assembly
from firmware_bridge.frames import Frames
from firmware_bridge.samples import GAP, ROW, Samples, join
from tests.bridge.machine import CATALOG, SIGNALS, START_US, assembly, cycles, without


def run(frames: Frames, declared: Assembly, chunk: int = 10**9) -> tuple[Samples, dict[str, int]]:
    assembler = Assembler(CATALOG, declared)
    parts = [assembler.push(part) for part in frames.chunks(chunk)] + [assembler.finish()]
    return join(parts), assembler.counters


def same(a: Samples, b: Samples) -> bool:
    return (
        np.array_equal(a.t_us, b.t_us)
        and np.array_equal(a.values, b.values)
        and np.array_equal(a.flags, b.flags)
    )


def damaged(n: int, seed: int) -> Frames:
    """Frames with losses, repeats, swaps, corrupted bytes, wrong lengths and foreign traffic."""
    rng = np.random.default_rng(seed)
    frames = cycles(n, seed)
    frames = without(frames, rng.integers(0, len(frames), len(frames) // 50))
    order = np.sort(np.concatenate([np.arange(len(frames)), rng.integers(0, len(frames), 40)]))
    for k in rng.integers(0, len(order) - 4, 40):
        order[[k, k + 3]] = order[[k + 3, k]]
    frames = frames[order]
    frames.data[rng.integers(0, len(frames), 40), rng.integers(0, 8, 40)] ^= 0x55
    frames.length[rng.integers(0, len(frames), 40)] = 5
    frames.can_id[rng.integers(0, len(frames), 40)] = 0x7FF
    return frames


@pytest.mark.parametrize("mode", ["cycle", "multirate"])
@pytest.mark.parametrize("counted", [True, False])
def test_chunks_of_any_size_give_identical_samples(mode: str, counted: bool) -> None:
    frames = damaged(1500, 1)
    declared = assembly(mode, counted)
    whole, counters = run(frames, declared)
    assert len(whole) > 1000
    assert counters["unknown_id"] and counters["wrong_length"] and counters["crc"]
    for chunk in (1, 7, 4096):
        part, part_counters = run(frames, declared, chunk)
        assert same(whole, part)
        assert part_counters == counters
    assert (np.diff(whole.t_us) > 0).all()
    assert np.isfinite(whole.values).all()


def test_reset_means_reset() -> None:
    frames = damaged(300, 2)
    for mode in ("cycle", "multirate"):
        assembler = Assembler(CATALOG, assembly(mode))
        first = assembler.push(frames)
        counters = assembler.counters
        assembler.reset()
        assert assembler.counters == {}
        assert same(first, assembler.push(frames))
        assert assembler.counters == counters


def test_clean_cycles_are_all_used() -> None:
    frames = cycles(500)
    samples, counters = run(frames, assembly())
    assert counters == {}
    assert len(samples) == 500
    motion = frames.t_us[frames.can_id == CATALOG.can_id("Motion")]
    np.testing.assert_array_equal(samples.t_us, motion)
    assert samples.flags[0] == ROW | GAP
    assert (samples.flags[1:] == ROW).all()
    x = CATALOG.layouts("Motion", ["X"]).decode(frames.data)[frames.can_id == 290, 0]
    np.testing.assert_array_equal(samples.column("x_m"), x)


def test_offset_moves_the_sample() -> None:
    declared = assembly()
    messages = tuple(replace(m, offset_s=0.25e-3) for m in declared.messages)
    moved, _ = run(cycles(20), replace(declared, messages=messages))
    plain, _ = run(cycles(20), declared)
    np.testing.assert_array_equal(moved.t_us, plain.t_us - 250)


@pytest.mark.parametrize("lost", [1, 15, 16, 32, 256])
def test_every_burst_loss_is_flagged(lost: int) -> None:
    frames = cycles(600)
    gone = (frames.t_us >= START_US + 100_000) & (frames.t_us < START_US + 1000 * (100 + lost))
    samples, counters = run(frames[~gone], assembly())
    assert len(samples) == 600 - lost
    assert counters["gap"] == 1
    np.testing.assert_array_equal(np.flatnonzero(samples.flags & GAP), [0, 100])


def test_lost_frame_loses_its_cycle_only() -> None:
    frames = cycles(100)
    samples, counters = run(without(frames, [150]), assembly())
    assert len(samples) == 99
    assert counters["incomplete_cycle"] == 1
    assert counters["counter_jump"] == 1
    np.testing.assert_array_equal(np.flatnonzero(samples.flags & GAP), [0, 50])


def test_repeated_and_swapped_frames_are_used_once() -> None:
    frames = cycles(100)
    twice = frames[np.repeat(np.arange(len(frames)), 2)]
    samples, counters = run(twice, assembly())
    assert same(samples, run(frames, assembly())[0])
    assert counters == {"counter_repeat": 300}
    order = np.arange(len(frames))
    order[[30, 33]] = order[[33, 30]]
    samples, counters = run(frames[order], assembly())
    assert counters["out_of_order"] == 1
    assert len(np.unique(samples.t_us)) == len(samples) >= 98


def test_frame_delayed_into_the_next_cycle_still_counts() -> None:
    frames = cycles(50)
    motion = np.flatnonzero(frames.can_id == CATALOG.can_id("Motion"))
    order = np.insert(np.delete(np.arange(len(frames)), motion[10]), motion[10] + 2, motion[10])
    samples, counters = run(frames[order], assembly())
    assert len(samples) == 50
    assert counters == {}


def test_without_counters_a_cycle_lasts_half_a_period() -> None:
    frames = cycles(200, 3)
    frames.t_us[:] = (
        START_US + np.arange(len(frames)) // 3 * 1000 + np.arange(len(frames)) % 3 * 100
    )
    samples, counters = run(frames, assembly(counted=False))
    assert len(samples) == 200 and counters == {}
    samples, counters = run(without(frames, [31]), assembly(counted=False))
    assert len(samples) == 199
    assert counters["incomplete_cycle"] == 1


def test_corrupted_wrong_length_foreign_and_absent_frames_are_counted() -> None:
    frames = cycles(100)
    frames.data[30, 5] ^= 1
    frames.length[60] = 7
    frames.can_id[90] = 0x123
    samples, counters = run(frames, assembly())
    assert len(samples) == 97
    assert (counters["crc"], counters["wrong_length"], counters["unknown_id"]) == (1, 1, 1)
    frames = cycles(100)
    pressures = np.flatnonzero(frames.can_id == CATALOG.can_id("Pressures"))
    frames.data[pressures[5], 2:4] = 0xFF
    samples, counters = run(frames, assembly(protected=False))
    assert counters["not_available"] == 1
    assert len(samples) == 99


def test_source_counts_reach_the_counters() -> None:
    frames = cycles(10)
    frames.refused["truncated"] = 1
    assert run(frames, assembly(), 5)[1] == {"truncated": 1}


def multirate(offsets_s: tuple[float, float, float] = (0, 0, 0)) -> tuple[Frames, Assembly]:
    """u every 10 ms, p every 5 ms, x every 20 ms, ramps in time, unsynchronised."""
    from firmware_bridge.encode import encode_message

    periods_us, starts_us = (10_000, 5_000, 20_000), (1_300, 700, 2_900)
    parts, messages = [], []
    for name, period, start, offset in zip(
        ("ValveCommand", "Pressures", "Motion"), periods_us, starts_us, offsets_s, strict=True
    ):
        t_us = START_US + np.arange(start, 1_000_000, period)
        s = (t_us - START_US) * 1e-6 - offset
        columns: dict[str, Any] = {
            "ValveCommand": {"U": 5 * s, "PTank": 1e5},
            "Pressures": {"PA": 1e6 * (1 + s), "PB": 2e6, "PSupply": 7e6},
            "Motion": {"X": 0.1 + 0.2 * s, "V": 0.2},
        }[name]
        parts.append(encode_message(CATALOG, name, t_us, columns))
        source = CATALOG.message_source(name)
        messages.append(replace(source, period_s=period * 1e-6, offset_s=offset))
    declared = Assembly("multirate", SIGNALS, tuple(messages), "x_m")
    return fr.by_time(fr.concatenate(parts)), declared


@pytest.mark.parametrize("offsets_s", [(0, 0, 0), (0.0031, 0.0007, 0.0123)])
def test_multirate_interpolates_and_holds(offsets_s: tuple[float, float, float]) -> None:
    frames, declared = multirate(offsets_s)
    samples, counters = run(frames, declared)
    s = (samples.t_us - START_US) * 1e-6
    inner = slice(1, None)
    np.testing.assert_allclose(samples.column("x_m"), 0.1 + 0.2 * s, atol=8e-6)
    np.testing.assert_allclose(samples.column("p_a_pa"), 1e6 * (1 + s), atol=155)
    u_us = frames.t_us[frames.can_id == CATALOG.can_id("ValveCommand")] - round(offsets_s[0] * 1e6)
    held = u_us[np.searchsorted(u_us, samples.t_us, "right") - 1]
    np.testing.assert_allclose(
        samples.column("u_v")[inner], 5e-6 * (held - START_US)[inner], atol=2e-4
    )
    x_us = frames.t_us[frames.can_id == CATALOG.can_id("Motion")] - round(offsets_s[2] * 1e6)
    np.testing.assert_array_equal((samples.flags & ROW) > 0, np.isin(samples.t_us, x_us))
    instants = np.unique(
        np.concatenate(
            [
                frames.t_us[frames.can_id == CATALOG.can_id(name)] - round(offset * 1e6)
                for name, offset in zip(("ValveCommand", "Pressures", "Motion"), offsets_s,
                                        strict=True)
            ]
        )
    )  # fmt: skip
    inside = (instants >= samples.t_us[0]) & (instants <= samples.t_us[-1])
    np.testing.assert_array_equal(samples.t_us, instants[inside])
    assert "gap" not in counters and "silent" not in counters
    assert len(samples) > 300


def test_monitored_command_carries_its_mean_to_the_next_sample() -> None:
    frames, declared = multirate()
    signals = (replace(SIGNALS[0], hold="linear", command=True), *SIGNALS[1:])
    samples, _ = run(frames, replace(declared, signals=signals))
    s = (samples.t_us - START_US) * 1e-6
    np.testing.assert_allclose(samples.column("u_v")[:-1], 5 * (s[:-1] + s[1:]) / 2, atol=2e-4)


def test_silent_message_breaks_the_samples() -> None:
    frames, declared = multirate()
    motion = frames.can_id == CATALOG.can_id("Motion")
    s = (frames.t_us - START_US) * 1e-6
    samples, counters = run(frames[~(motion & (s > 0.4) & (s < 0.6))], declared)
    assert counters["silent"] > 50
    assert counters["gap"] == 1
    gap = np.flatnonzero(samples.flags & GAP)[1]
    assert samples.t_us[gap] - samples.t_us[gap - 1] > 190_000
    short, counters = run(frames[~(motion & (s > 0.4) & (s < 0.47))], declared)
    assert "silent" not in counters
    assert len(np.flatnonzero(short.flags & GAP)) == 1


def test_memory_is_bounded_while_a_message_is_silent_for_long() -> None:
    frames, declared = multirate()
    motion = frames.can_id == CATALOG.can_id("Motion")
    only = without(frames, np.flatnonzero(motion)[3:-3])
    assembler = Assembler(CATALOG, declared)
    declared_capacity = assembler._multirate.times.shape[1]  # type: ignore[union-attr]
    parts = [assembler.push(part) for part in only.chunks(50)]
    assert assembler._multirate.queues["count"].max() <= declared_capacity  # type: ignore[union-attr]
    assert len(np.flatnonzero(join(parts).flags & GAP)) == 2


def test_role_conversions() -> None:
    declared = assembly()
    signals = (
        replace(SIGNALS[0], factor=2.0, offset=1.0),
        replace(SIGNALS[1], table=((0.0, 2e6, 1e7), (0.0, 1.0, 2.0))),
        replace(SIGNALS[4], constant=1e5),
        SIGNALS[5],
    )
    plain, _ = run(cycles(50), declared)
    samples, _ = run(cycles(50), replace(declared, signals=signals))
    np.testing.assert_array_equal(samples.values[:, 0], 2.0 * plain.values[:, 0] + 1.0)
    expected = np.interp(plain.values[:, 1], *signals[1].table)  # type: ignore[misc]
    np.testing.assert_allclose(samples.values[:, 1], expected, rtol=1e-14)
    assert (samples.values[:, 2] == 1e5).all()


def test_contradictory_assemblies_are_refused() -> None:
    good = assembly()
    cases = [
        (replace(good, mode="fast"), "mode 'fast'"),
        (replace(good, row_signal="y"), "row_signal 'y'"),
        (replace(good, messages=good.messages[:2]), "'Motion' is not among"),
        (replace(good, messages=(*good.messages[:2], replace(good.messages[2], period_s=0))),
         "period_s"),
        (replace(good, messages=(*good.messages[:2], replace(good.messages[2], counter=None))),
         "counter for all"),
    ]  # fmt: skip
    for declared, text in cases:
        with pytest.raises(AssemblyError, match=text):
            Assembler(CATALOG, declared)
    wrong = replace(good, signals=(replace(SIGNALS[0], signal="UU"), *SIGNALS[1:]))
    with pytest.raises(CatalogError, match="'U'"):
        Assembler(CATALOG, wrong)
