"""The gates of the frames on streams of a few cycles: every border from both sides.

Small on purpose: `tools/mutate.py` runs these with each operator of the gates changed in turn.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np
import pytest

from firmware_bridge import frames as fr
from firmware_bridge.assemble import Assembler
from firmware_bridge.catalog import load
from firmware_bridge.config import Assembly, MessageSource, SignalSource
from firmware_bridge.e2e import crc8_bulk
from firmware_bridge.encode import encode_message
from firmware_bridge.frames import Frames
from firmware_bridge.samples import GAP, ROW, Samples
from tests.bridge.machine import CATALOG, SIGNALS, START_US, assembly

PERIOD_US = 1000
VALUES = {
    "ValveCommand": {"U": 1.0, "XRef": 0.2, "PTank": 1e5},
    "Pressures": {"PA": 3e6, "PB": 2e6, "PSupply": 9e6},
    "Motion": {"X": 0.25, "V": 0.1, "Mode": 2},
}


def message(name: str, t_us: int, counter: int, channel: int = 0, **values: float) -> Frames:
    """One good frame, t_us after START_US."""
    told = VALUES[name] | values
    at = np.array([START_US + t_us])
    return encode_message(CATALOG, name, at, told, counter=[counter % 16], channel=channel)


def cycle(k: int, counter: int | None = None, t_us: int | None = None, **values: float) -> Frames:
    """The three frames of cycle k, 100 us apart."""
    at, count = k * PERIOD_US if t_us is None else t_us, k if counter is None else counter
    own = {name: {s: v for s, v in values.items() if s in VALUES[name]} for name in VALUES}
    parts = [message(n, at + 100 * i, count, 0, **own[n]) for i, n in enumerate(VALUES)]
    return fr.concatenate(parts)


def run(frames: list[Frames], declared: Assembly | None = None) -> tuple[Samples, dict[str, int]]:
    """The samples, and what was counted (zeros left out)."""
    assembler = Assembler(CATALOG, declared or assembly())
    samples = assembler.push(fr.concatenate(frames))
    assembler.finish()
    return samples, {name: n for name, n in assembler.counters.items() if n}


def verdict(dt_us: int, step: int) -> str:
    """What becomes of a frame that comes dt_us and so many counts after a good one."""
    first, second = message("Pressures", 0, 5), message("Pressures", dt_us, 5 + step)
    counted = run([first, second])[1]
    counted.pop("incomplete_cycle", None)
    return " ".join(counted) or "ok"


@pytest.mark.parametrize(("dt_us", "step", "expected"), [
    (1000, 1, "ok"), (1, 1, "ok"), (5000, 1, "ok"), (0, 1, "out_of_order"), (-9, 1, "out_of_order"),
    (1000, 0, "counter_repeat"), (1500, 0, "counter_repeat"), (1501, 0, "counter_jump"),
    (0, 0, "counter_repeat"), (-2000, 0, "counter_repeat"), (16_000, 0, "counter_jump"),
    (1000, 2, "counter_jump"), (999, 2, "out_of_order"), (2000, 2, "counter_jump"),
    (1500, 3, "counter_jump"), (1499, 3, "out_of_order"), (-1, 2, "out_of_order"),
    (4000, 8, "counter_jump"), (3999, 8, "out_of_order"), (400, 8, "out_of_order"),
    (7500, 15, "counter_jump"), (7499, 15, "out_of_order"), (1000, 15, "out_of_order"),
])  # fmt: skip
def test_a_counter_is_judged_with_the_time(dt_us: int, step: int, expected: str) -> None:
    assert verdict(dt_us, step) == expected


def test_a_refused_frame_leaves_no_trace_and_an_accepted_one_is_the_new_last() -> None:
    """Of the same message: good, too soon for its counter, good again; then a loss of one."""
    frames = [message("Pressures", *at) for at in ((0, 0), (400, 8), (1000, 1), (3000, 3))]
    assembler = Assembler(CATALOG, assembly())
    assembler.push(fr.concatenate(frames))
    row = assembler.messages[1]
    assert assembler.counters == {"out_of_order": 1, "counter_jump": 1}
    assert (row["good"], row["gap_us"], row["counter"]) == (3, 2000, 3)
    assert row["t_us"] == START_US + 3000 and row["refused"].sum() == 2
    assert assembler.messages["good"].tolist() == [0, 3, 0]


def test_a_single_first_frame_has_no_gap_behind_it() -> None:
    assembler = Assembler(CATALOG, assembly())
    assembler.push(message("Pressures", 0, 9))
    assert assembler.messages[1]["gap_us"] == 0 and not assembler.counters


@pytest.mark.parametrize("byte", range(8))
def test_a_changed_byte_is_refused_by_the_crc(byte: int) -> None:
    frame = message("Pressures", 0, 0)
    frame.data[0, byte] ^= 0x10
    samples, counted = run([frame])
    assert counted == {"crc": 1} and not len(samples)


def test_length_identifier_and_channel() -> None:
    short, foreign = message("Pressures", 0, 0), message("Pressures", 0, 0)
    short.length[:] = 7
    foreign.can_id[:] = 0x7FF
    assert run([short])[1] == {"wrong_length": 1}
    assert run([foreign])[1] == {"unknown_id": 1}
    listens = [replace(m, channel=1) for m in assembly().messages]
    declared = replace(assembly(), messages=tuple(listens))
    assert run([message("Pressures", 0, 0)], declared)[1] == {"unknown_id": 1}
    assert run([message("Pressures", 0, 0, channel=1)], declared)[1] == {"incomplete_cycle": 1}
    assert run([message("Pressures", 0, 0, channel=1)])[1] == {"incomplete_cycle": 1}
    listens = [replace(m, channel=0) for m in assembly().messages]
    declared = replace(assembly(), messages=tuple(listens))
    assert run([message("Pressures", 0, 0, channel=1)], declared)[1] == {"unknown_id": 1}


def test_without_a_crc_or_a_counter_they_are_not_asked_for() -> None:
    frames = [cycle(k) for k in range(3)]
    for one in frames:
        one.data[:, 7] ^= 0
    protected = run(frames, assembly(protected=False))
    assert len(protected[0]) == 3 and not protected[1]
    uncounted = run(
        [cycle(k, counter=0) for k in range(3)], assembly(counted=False, protected=False)
    )
    assert len(uncounted[0]) == 3 and not uncounted[1]


def test_what_is_not_available_moves_the_counter_on() -> None:
    frames = [cycle(0), cycle(1, PA=np.nan), cycle(2)]
    samples, counted = run(frames)
    assert counted == {"not_available": 1, "incomplete_cycle": 1, "gap": 1}
    assert (samples.t_us - START_US).tolist() == [200, 2200]
    assert samples.flags.tolist() == [ROW | GAP, ROW | GAP]


def test_values_by_factor_offset_and_table() -> None:
    """A table is linear between its points and constant beyond them."""
    table = (0.0, 1e6, 2e6, 5e6), (10.0, 20.0, 50.0, 20.0)
    of_table = replace(SIGNALS[1], table=table)
    scaled = replace(SIGNALS[2], factor=2.0, offset=-1e6)
    declared = replace(assembly(), signals=(SIGNALS[0], of_table, scaled, *SIGNALS[3:]))
    asked = [0.0, 0.5e6, 1e6, 1.5e6, 2e6, 3.5e6, 5e6, 8e6]
    samples, counted = run([cycle(k, PA=p, PB=p) for k, p in enumerate(asked)], declared)
    assert not counted
    found = samples.values[:, [samples.names.index(n) for n in ("p_a_pa", "p_b_pa")]]
    expected = np.interp(asked, *table)
    np.testing.assert_allclose(found[:, 0], expected, atol=0.01)
    np.testing.assert_allclose(found[:, 1], 2.0 * np.array(asked) - 1e6, atol=2e3)


def test_a_table_of_two_points() -> None:
    declared = replace(
        assembly(),
        signals=(SIGNALS[0], replace(SIGNALS[1], table=((1e6, 3e6), (0.0, 4.0))),
                 *SIGNALS[2:]),
    )  # fmt: skip
    samples, _ = run([cycle(k, PA=p) for k, p in enumerate([0.0, 1e6, 1.5e6, 3e6, 4e6])], declared)
    column = samples.names.index("p_a_pa")
    np.testing.assert_allclose(samples.values[:, column], [0, 0, 1, 4, 4], atol=1e-3)


def test_a_cycle_is_a_sample_at_the_time_of_its_position() -> None:
    offset = replace(assembly().messages[2], offset_s=50e-6)
    declared = replace(assembly(), messages=(*assembly().messages[:2], offset))
    samples, counted = run([cycle(k) for k in range(4)], declared)
    assert (samples.t_us - START_US).tolist() == [150, 1150, 2150, 3150]
    assert samples.flags.tolist() == [ROW | GAP, ROW, ROW, ROW] and not counted
    np.testing.assert_allclose(samples.values[0, [0, 1, 5]], [1.0, 3e6, 0.25], rtol=1e-3)


@pytest.mark.parametrize(("dt_us", "gaps"), [(1500, 0), (1501, 1)])
def test_a_gap_begins_beyond_one_and_a_half_periods(dt_us: int, gaps: int) -> None:
    samples, counted = run([cycle(0), cycle(1, t_us=dt_us)])
    assert counted == ({"gap": 1} if gaps else {})
    assert samples.flags.tolist() == [ROW | GAP, ROW | GAP * gaps]


def test_a_lost_count_is_a_gap_however_soon() -> None:
    """All three messages have lost a frame, but the next cycle comes in time."""
    samples, counted = run([cycle(0), cycle(2, t_us=1200)])
    assert counted == {"counter_jump": 3, "gap": 1} and samples.flags[1] & GAP


def test_a_delayed_frame_finds_its_cycle() -> None:
    """Motion of cycle 0 comes after the first frames of cycle 1."""
    a, b, late = cycle(0), cycle(1), message("Motion", 1150, 0)
    samples, counted = run([a[:2], b[:2], late, b[2:]])
    assert not counted
    assert (samples.t_us - START_US).tolist() == [1150, 1200]


def test_older_cycles_can_no_longer_be_completed() -> None:
    a, b = cycle(0), cycle(1)
    samples, counted = run([a[:2], b, cycle(2)])
    assert counted["incomplete_cycle"] == 1
    assert (samples.t_us - START_US).tolist() == [1200, 2200]


def test_older_cycles_end_when_a_newer_one_is_complete() -> None:
    assembler = Assembler(CATALOG, assembly())
    assembler.push(fr.concatenate([cycle(0)[:2], cycle(1)[:1], cycle(2)]))
    before = assembler.counters["incomplete_cycle"]
    assembler.finish()
    assert before == assembler.counters["incomplete_cycle"] == 2


def test_crc_and_counter_wherever_they_are() -> None:
    """The counter in the first bits, the CRC in the last byte."""
    with NamedTemporaryFile("w", suffix=".dbc") as file:
        file.write(OTHER_DBC)
        file.flush()
        catalog = load(Path(file.name))
    sources = (MessageSource("M", 1e-3, counter="Counter", crc="Crc", data_id=0x33),)
    declared = Assembly("cycle", (SignalSource("x_m", "M", "X"),), sources, "x_m")
    frames, layouts = fr.empty(4), catalog.layouts("M")
    columns = np.zeros((4, len(layouts.names)))
    columns[:, layouts.names.index("Counter")] = [0, 1, 1, 3]
    columns[:, layouts.names.index("X")] = 7.0
    frames.t_us[:] = START_US + PERIOD_US * np.arange(4)
    frames.can_id[:], frames.length[:] = catalog.can_id("M"), 8
    frames.data[:] = layouts.encode(columns)
    frames.data[:, 7] = crc8_bulk(frames.data, 8, 7, 0x33)
    assembler = Assembler(catalog, declared)
    samples = assembler.push(frames)
    assert assembler.counters == {"counter_repeat": 1, "counter_jump": 1, "gap": 1}
    assert samples.values[:, 0].tolist() == [7.0] * 3
    frames.data[:, 7] ^= 1
    assembler = Assembler(catalog, declared)
    assembler.push(frames)
    assert assembler.counters == {"crc": 4}


OTHER_DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 291 M: 8 A
 SG_ Counter : 0|4@1+ (1,0) [0|15] "" A
 SG_ X : 8|16@1+ (1,0) [0|65535] "m" A
 SG_ Crc : 56|8@1+ (1,0) [0|255] "" A
"""


def test_a_cycle_that_comes_twice_is_no_second_sample() -> None:
    samples, counted = run([cycle(0), cycle(0), cycle(1)])
    assert counted == {"counter_repeat": 3} and len(samples) == 2


def test_slots_are_used_again_after_sixteen_cycles() -> None:
    """An open cycle of 16 counts before is not filled up by its successor in the slot."""
    frames = [cycle(0)[:1], *[cycle(k) for k in range(1, 33)]]
    samples, counted = run(frames)
    assert counted["incomplete_cycle"] == 1 and len(samples) == 32
    old = [cycle(0)[:1], message("Pressures", 16_100, 16), message("Motion", 16_200, 16)]
    samples, counted = run(old)
    assert not len(samples) and counted["incomplete_cycle"] == 2


def test_without_counters_a_cycle_lasts_half_a_period() -> None:
    plain = assembly(counted=False)
    for late_us, whole in ((500, True), (501, False)):
        frames = [message("ValveCommand", 0, 0), message("Pressures", 100, 0),
                  message("Motion", late_us, 0)]  # fmt: skip
        samples, counted = run(frames, plain)
        assert len(samples) == whole
        assert counted == ({} if whole else {"incomplete_cycle": 2})


def test_the_same_message_again_begins_a_new_cycle() -> None:
    plain = assembly(counted=False)
    frames = [message("ValveCommand", 0, 0), message("ValveCommand", 200, 0),
              message("Pressures", 300, 0), message("Motion", 400, 0)]  # fmt: skip
    samples, counted = run(frames, plain)
    assert len(samples) == 1 and counted == {"incomplete_cycle": 1}


def test_a_sample_older_than_the_last_one_is_refused() -> None:
    """Two cycles whose positions are out of order."""
    first, second = cycle(0), cycle(1)
    second.t_us[2] = first.t_us[2] + 1
    samples, _ = run([first, second])
    assert len(samples) == 2
    offset = [replace(m, offset_s=1e-3 if m.name == "Motion" else 0.0) for m in assembly().messages]
    assert len(run([first, second], replace(assembly(), messages=tuple(offset)))[0]) == 2


def test_a_constant_is_in_every_sample() -> None:
    constant = SignalSource("u_v", "", "", constant=7.0)
    declared = replace(assembly(), signals=(constant, *SIGNALS[1:]))
    samples, _ = run([cycle(k) for k in range(3)], declared)
    assert samples.values[:, 0].tolist() == [7.0] * 3
