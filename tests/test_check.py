"""`rtid check`: clean traces pass, wrong units and signs are named, a raw capture is timed."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomlkit
from scipy.signal import lfilter

from firmware_bridge.frames import EXTENDED, empty
from firmware_bridge.samples import ROW, Samples
from rtid.daemon.first import wrong_signs
from rtid.estimator.noise import estimate_noise
from rtid.model import Machine
from rtid.project import load
from rtid.sim.declare import declared_model
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.trace.arrivals import bus, timing
from rtid.trace.check import Finding, Report, against_signs, judge
from rtid.trace.plausible import Motion, Spring, motion
from rtid.trace.series import Series, describe, longest_frozen
from rtid.trace.signals import read_recording
from tests.command import called
from tests.replays import shared_replays  # noqa: F401

ROOT = Path(__file__).parents[1]
Edit = Callable[[dict[str, Any]], None]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20 s of the simulated machine as trace.parquet and trace.toml."""
    found = tmp_path_factory.mktemp("check")
    from rtid.sim.project_file import project_text
    from rtid.sim.run_files import write_table

    recorded = simulate(SimulatedPlant(), "rich", 1, 20.0)
    write_table(found / "trace.parquet", recorded)
    text = project_text(declared_model(recorded.plant, sensors=recorded.sensors), 0.5, "simulated")
    (found / "trace.toml").write_text(text)
    return found


def judged(folder: Path, edit: Edit) -> Report:
    """The trace judged by the edited project."""
    raw = tomlkit.parse((folder / "trace.toml").read_text()).unwrap()
    for signal in raw["signals"].values():
        signal.pop("range", None)  # the unit must be found out without it
        signal.setdefault("scale", 1.0)
        signal.pop("message", None)
        signal.pop("signal", None)
    raw["source"] = {"time_column": "t"}
    raw.pop("messages", None)
    edit(raw)
    path = folder / "edited.toml"
    path.write_text(tomlkit.dumps(raw))
    project = load(path)
    trace = read_recording(project, folder / "trace.parquet")
    return judge(
        project.model, project.assembly, trace.samples, trace.series, trace.messages,
        trace.refused, project.sections.stroke_m,
    )  # fmt: skip


def errors(report: Report) -> dict[str, Finding]:
    return {f.subject: f for f in report.findings if f.level == "error"}


def test_clean_trace_passes(folder: Path) -> None:
    report = judged(folder, lambda raw: None)
    assert report.ok and not errors(report)
    assert report.samples.rate_hz == pytest.approx(1000)
    assert min(one.enough for one in report.coverage) > 10
    assert report.motion.v_slope == pytest.approx(1, abs=0.02)


def test_gaps_are_told_by_what_they_take(folder: Path, tmp_path: Path) -> None:
    """However few: of a record that misses a fifth in two gaps nothing was said."""
    table = pq.read_table(folder / "trace.parquet")
    kept = [table.slice(0, 5000), table.slice(6000, 4000), table.slice(13_000)]
    pq.write_table(pa.concat_tables(kept), tmp_path / "trace.parquet")
    (tmp_path / "trace.toml").write_text((folder / "trace.toml").read_text())
    found = {f.subject: f for f in judged(tmp_path, lambda raw: None).findings}["trace.parquet"]
    assert found.level == "warning"
    assert "2 of 16000 steps" in found.text and "at worst 3001 ms: 20 % of" in found.text


def unit(name: str, written: str) -> Edit:
    def edit(raw: dict[str, Any]) -> None:
        raw["signals"][name]["unit"] = written

    return edit


def all_pressures(written: str) -> Edit:
    def edit(raw: dict[str, Any]) -> None:
        for name in ("p_a", "p_b", "p_supply", "p_tank"):
            raw["signals"][name]["unit"] = written

    return edit


def turned(name: str, offset: float = 0.0) -> Edit:
    def edit(raw: dict[str, Any]) -> None:
        raw["signals"][name] |= {"scale": -1.0, "offset": offset}

    return edit


def swapped(raw: dict[str, Any]) -> None:
    a, b = raw["signals"]["p_a"], raw["signals"]["p_b"]
    a["column"], b["column"] = b["column"], a["column"]


@pytest.mark.parametrize(
    "edit,subject,words",
    [
        (unit("p_supply", "kPa"), "p_supply", "looks like Pa"),
        (unit("p_a", "bar"), "p_a", "looks like Pa"),
        (unit("p_b", "MPa"), "p_b", "looks like Pa"),
        (unit("p_tank", "bar"), "p_tank", "looks like Pa"),
        (all_pressures("bar"), "p_a", "looks like Pa"),
        (all_pressures("bar"), "chambers.a", "bulk modulus"),
        (unit("x", "mm"), "x", "looks like m"),
        (unit("v", "mm/s"), "v", "derivative"),
        (turned("u"), "u", "reversed"),
        (turned("x", 0.5), "x", "reversed"),
        (turned("v"), "v", "derivative"),
        (swapped, "chambers", "swapped"),
    ],
)  # fmt: skip
def test_wrong_unit_or_sign_is_named(folder: Path, edit: Edit, subject: str, words: str) -> None:
    report = judged(folder, edit)
    assert not report.ok
    assert words in errors(report)[subject].text
    assert errors(report)[subject].remedy


def test_a_spring_that_is_no_oil_speaks_against_no_sign(folder: Path) -> None:
    """Slow motion bends the rough law: with warm oil a sweep gave t = -9 and 5.8 GPa."""
    model = load(folder / "trace.toml").model
    a, nothing = Spring(1.7e9, 11.0), float("nan")
    slow, reverse = Spring(-5.8e9, -9.1), Spring(-1.5e9, -25.0)
    assert not [*against_signs(model, Motion(0.96, {"a": a, "b": slow}, nothing))]
    (finding,) = against_signs(model, Motion(0.96, {"a": a, "b": reverse}, nothing))
    assert finding.subject == "chambers.b"
    (finding,) = against_signs(model, Motion(0.96, {"a": slow, "b": reverse}, nothing))
    assert "swapped" in finding.text


def test_a_chamber_that_settles_between_samples_tells_no_sign(folder: Path) -> None:
    model, nothing = load(folder / "trace.toml").model, Spring(math.nan, math.nan)
    settled = Motion(0.97, {"a": nothing, "b": Spring(-5e8, -10.0, 0.05)}, math.nan, 0.1)
    (finding,) = against_signs(model, settled)
    assert (finding.level, finding.subject) == ("warning", "chambers")
    assert "over 100 ms: the rate cannot tell" in finding.text


@pytest.mark.parametrize("step", [10, 20, 50])
def test_a_slow_record_turns_no_sensor_round(step: int) -> None:
    """20 samples a second: the pressure that fell was right, and turning it round made it wrong."""
    recorded = simulate(SimulatedPlant(), "sweep", 1, 60.0)
    model = declared_model(recorded.plant, sensors=recorded.sensors)
    model = replace(model, gates=replace(model.gates, max_gap_s=0.15))
    slow = every(recorded.samples, step)
    moves = motion(model, slow)
    assert not [*against_signs(model, moves)]
    assert 0.02 < moves.springs["b"].settles_s < 0.1
    chunk = np.column_stack([1e-6 * slow.t_us, slow.flags, slow.values])
    assert wrong_signs(model, chunk) == ()


@pytest.mark.parametrize("step", [1, 5, 10])
def test_a_chamber_is_a_spring_beside_what_its_valves_let_through(step: int) -> None:
    """Beside the level of its pressure alone a drained chamber was softer than nothing."""
    recorded = simulate(SimulatedPlant(), "sweep", 1, 60.0)
    model = declared_model(recorded.plant, sensors=recorded.sensors)
    springs = motion(model, every(recorded.samples, step)).springs.values()
    assert min(spring.t for spring in springs) > 30.0
    assert [s.beta_pa for s in springs] == pytest.approx([850e6, 850e6], rel=0.1)


@pytest.mark.parametrize("step", [1, 5, 10, 20])
def test_swapped_pressures_are_named_down_to_the_rate_that_tells(step: int) -> None:
    """50 samples a second are enough for the chamber that settles within 60 ms."""
    recorded = simulate(SimulatedPlant(), "rich", 1, 40.0)
    model = declared_model(recorded.plant, sensors=recorded.sensors)
    model = replace(model, gates=replace(model.gates, max_gap_s=0.06))
    names = {"p_a": "p_b", "p_b": "p_a"}
    turned = [recorded.samples.names.index(names.get(n, n)) for n in recorded.samples.names]
    samples = replace(recorded.samples, values=recorded.samples.values[:, turned])
    found = list(against_signs(model, motion(model, every(samples, step))))
    assert [f.level for f in found] == ["error"] and "swapped" in found[0].text


def every(samples: Samples, step: int) -> Samples:
    """Each sample of so many."""
    values, flags = samples.values[::step], samples.flags[::step]
    return Samples(samples.names, samples.t_us[::step], values, flags)


def test_wrong_noise_is_a_warning_with_the_right_figure(folder: Path) -> None:
    def quiet(raw: dict[str, Any]) -> None:
        raw["signals"]["p_a"]["noise"] = 1e3

    report = judged(folder, quiet)
    (found,) = [f for f in report.findings if f.subject == "p_a"]
    figure = re.search(r"noise is (\S+) MPa", found.text)
    assert report.ok and figure and float(figure[1]) == pytest.approx(5e-3, rel=0.015)


def test_grid_that_misses_the_motion_is_named(folder: Path) -> None:
    def elsewhere(raw: dict[str, Any]) -> None:
        for key in [k for k in raw["edges"]["pa"] if k.startswith("dp_grid")]:
            del raw["edges"]["pa"][key]
        raw["edges"]["pa"]["dp_grid_mpa"] = [20, 21, 22]

    found = [f for f in judged(folder, elsewhere).findings if f.subject == "edges.pa"]
    assert {f.level for f in found} == {"error", "warning"}
    assert any("outside the grid" in f.text for f in found)


def test_a_command_below_a_grid_without_a_safe_band_is_named(folder: Path) -> None:
    """Half the record would be learned from in no block; a clean file says nothing of it."""

    def without(raw: dict[str, Any]) -> None:
        for section in (raw.get("edge_defaults", {}), *raw["edges"].values()):
            for key in [k for k in section if k.startswith("safe_band")]:
                del section[key]

    found = [f for f in judged(folder, without).findings if "no safe_band" in f.text]
    assert {f.subject for f in found} == {"edges.pa", "edges.at", "edges.pb", "edges.bt"}
    assert all(f.level == "warning" for f in found)
    share = re.search(r"for (\d+) % of the record", found[0].text)
    assert share and 20 < float(share[1]) < 80
    clean = judged(folder, lambda raw: None)
    assert not any("no safe_band" in f.text for f in clean.findings)


def test_noise_is_found_under_motion_and_quantisation() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(20_000) * 1e-3
    motion = 0.15 * np.sin(2 * np.pi * 0.5 * t)
    noisy = motion + rng.normal(0, 1e-5, len(t))
    assert estimate_noise(t, noisy).sd == pytest.approx(1e-5, rel=0.03)
    noisy[::500] += 0.01  # outliers must not count
    rounded = np.round(noisy / 7.6e-6) * 7.6e-6
    assert estimate_noise(t, rounded).sd == pytest.approx(1.02e-5, rel=0.05)
    assert estimate_noise(t, motion).sd < 1e-9
    late = 0.02 * np.arange(4000) + rng.uniform(-2e-3, 2e-3, 4000)  # 50 Hz with jitter
    slow = 0.15 * np.sin(2 * np.pi * 0.3 * late) + rng.normal(0, 1e-5, len(late))
    t_us = np.rint(late * 1e6).astype(np.int64)
    assert estimate_noise(t_us * 1e-6, slow).sd == pytest.approx(1e-5, rel=0.06)
    assert np.isinf(estimate_noise(t[:10], motion[:10]).relative_sd)


def test_series_without_values_and_frozen_spans() -> None:
    t_us = np.arange(3000, dtype=np.int64) * 1000
    x = np.random.default_rng(2).normal(size=3000)
    x[1000:1800] = x[1000]
    span_s, start_s = longest_frozen(t_us, x)
    assert [span_s, start_s] == pytest.approx([0.799, 1.0])
    nothing = describe(Series("x", t_us, np.full(3000, np.nan)))
    assert (nothing.count, nothing.missing) == (0, 3000)


def test_a_time_that_begins_again_is_no_log_to_be_sorted(folder: Path, tmp_path: Path) -> None:
    """Half of the record was left out, and what to do was "sort the log"."""
    table = pq.read_table(folder / "trace.parquet")
    pq.write_table(pa.concat_tables([table, table]), tmp_path / "trace.parquet")
    (tmp_path / "trace.toml").write_text((folder / "trace.toml").read_text())
    found = judged(tmp_path, lambda raw: None).findings
    (said,) = (finding for finding in found if "go back" in finding.text)
    assert f"{len(table)} samples are left out" in said.text
    assert "two records in one file?" in said.remedy


def test_timing_counts_gaps_and_backward_stamps() -> None:
    t_us = np.arange(1000, dtype=np.int64) * 10_000
    t_us[500:] += 90_000
    found = timing(t_us)
    assert (found.count, found.gaps, found.backward) == (1000, 1, 0)
    assert [found.median_s, found.worst_s] == pytest.approx([0.01, 0.1])
    assert found.missing == pytest.approx(0.09 / 10.08)
    late = t_us[:500] + 6000 * (np.arange(500) % 3 == 1)  # and the next one comes in time
    assert timing(late).gaps > 100 and timing(late).missing < 2e-3
    assert timing(t_us[::-1]).backward == 999
    assert np.isnan(timing(t_us[:1]).median_s)


def test_bus_separates_channels_and_identifiers() -> None:
    frames = empty(6)
    frames.t_us[:] = [0, 1, 10, 11, 20, 21]
    frames.can_id[:] = [5, 5 | EXTENDED] * 3
    frames.channel[:] = [0, 1, 0, 1, 0, 2]
    found = [(one.channel, one.label, one.timing.count) for one in bus(frames)]
    assert found == [(0, "005", 3), (1, "00000005", 2), (2, "00000005", 1)]


def test_command_prints_a_verdict_and_ends_with_its_code(folder: Path, tmp_path: Path) -> None:
    done = called("check", folder / "trace.toml", folder / "trace.parquet")
    assert done.returncode == 0 and "Ready to learn" in done.stdout, done.stdout + done.stderr
    text = (folder / "trace.toml").read_text()
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(text.replace("direction = 1", "direction = 2"))
    done = called("check", wrong)
    assert done.returncode == 2 and "edges.pa.direction" in done.stderr
    done = called("check", folder / "trace.toml", tmp_path / "none.blf")
    assert done.returncode == 3 and "none.blf" in done.stderr


def test_command_says_negative_in_json(folder: Path) -> None:
    judged(folder, turned("u"))  # leaves edited.toml
    done = called("check", folder / "edited.toml", folder / "trace.parquet", "--json")
    report = json.loads(done.stdout)
    assert done.returncode == 4 and report["ok"] is False
    assert report["signals"][0]["name"] == "u"


def test_log_without_a_wanted_frame_says_what_it_holds(folder: Path, tmp_path: Path) -> None:
    log = tmp_path / "foreign.log"
    log.write_text("".join(f"(1.{k:06d}) can0 7DF#0102\n" for k in range(50)))
    done = called("check", folder / "trace.toml", log)
    assert done.returncode == 3 and "0x7DF" in done.stderr and "ValveCommand" in done.stderr
    done = called("check", "--bus-only", log)
    assert done.returncode == 0 and "50 frames, 1 ids" in done.stdout
    shutil.copy(log, tmp_path / "copy.log")
    assert json.loads(called("check", "--bus-only", log, "--json").stdout)["frames"] == 50


def test_log_of_savvycan_is_a_log_of_frames_and_no_table(folder: Path, tmp_path: Path) -> None:
    from firmware_bridge.sources import open_log
    from rtid.sim.bus import run_frames
    from rtid.sim.run import simulate
    from rtid.sim.run_files import START_US, write_log
    from rtid.sim.simulated_plant import SimulatedPlant

    run = simulate(SimulatedPlant(), "rich", 1, 2.0)
    write_log(tmp_path / "trace.blf", run_frames(run, start_us=START_US))
    frames = open_log(tmp_path / "trace.blf")
    lines = ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"]
    for t_us, can_id, n, data in zip(
        frames.t_us, frames.can_id, frames.length, frames.data, strict=True
    ):
        shown = "".join(f"{byte:02X}," for byte in data)
        lines.append(f"{t_us},{can_id:08X},false,Rx,0,{n},{shown}")
    (tmp_path / "trace.csv").write_text("\n".join([*lines, ""]))
    told = [
        json.loads(called("check", folder / "trace.toml", tmp_path / name, "--json").stdout)
        for name in ("trace.blf", "trace.csv")
    ]
    assert told[0] == told[1]
    assert told[0]["samples"]["count"] > 1900


LEFT_OUT = "remote_frame", "fd_frame", "error_frame"
CAPTURES = {  # data frames and those of `LEFT_OUT`, as python-can counts them, and the exit code
    "issue_1256.asc": (1457, (0, 0, 0), 0),
    "issue_1299.asc": (4, (0, 0, 0), 0),
    "issue_1905.blf": (22, (0, 0, 0), 0),
    "logfile.asc": (12, (4, 0, 4), 0),
    "logfile_errorframes.asc": (7, (2, 0, 3), 0),
    "single_frame.asc": (None, (), 3),  # 64 bytes in a classic frame
    "single_frame_us_locale.asc": (1, (0, 0, 0), 0),
    "test_CanErrorFrameExt.blf": (0, (0, 0, 2), 0),
    "test_CanErrorFrames.asc": (0, (0, 0, 4), 0),
    "test_CanFdMessage.asc": (3, (0, 0, 0), 0),
    "test_CanFdMessage.blf": (2, (0, 0, 0), 0),
    "test_CanFdMessage64.asc": (2, (0, 0, 0), 0),
    "test_CanFdMessage64.blf": (0, (2, 0, 0), 0),
    "test_CanFdRemoteMessage.asc": (0, (1, 0, 0), 0),
    "test_CanMessage.asc": (2, (0, 0, 0), 0),
    "test_CanMessage.asc.gz": (2, (0, 0, 0), 0),
    "test_CanMessage.blf": (0, (0, 0, 0), 0),  # two frames of 51 bytes, which no bus carries
    "test_CanMessage.trc": (2, (0, 0, 0), 0),
    "test_CanMessage2.blf": (0, (0, 0, 0), 0),  # the same
    "test_CanMessage_V1_0_BUS1.trc": (10, (0, 0, 0), 3),  # the last line, a remote frame, is open
    "test_CanMessage_V1_1.trc": (10, (1, 0, 0), 0),
    "test_CanMessage_V1_3.trc": (10, (1, 0, 0), 0),
    "test_CanMessage_V2_0_BUS1.trc": (10, (0, 0, 0), 3),  # the same
    "test_CanMessage_V2_1.trc": (10, (0, 0, 0), 3),  # the same
    "test_CanRemoteMessage.asc": (0, (3, 0, 0), 0),
}


@pytest.mark.parametrize("name", CAPTURES)
def test_every_capture_of_python_can_is_read_or_refused_in_one_line(
    shared: Path, name: str
) -> None:
    count, left_out, code = CAPTURES[name]
    done = called("check", "--bus-only", shared / "data/can_logs" / name, "--json")
    assert done.returncode == code
    assert len(done.stderr.splitlines()) == (code == 3)
    if count is not None:
        report = json.loads(done.stdout)
        assert report["frames"] == sum(one["timing"]["count"] for one in report["timing"]) == count
        assert tuple(report["refused"].get(kind, 0) for kind in LEFT_OUT) == left_out


def test_no_capture_of_python_can_is_left_untried(shared: Path) -> None:
    assert {path.name for path in (shared / "data/can_logs").iterdir()} == set(CAPTURES)


def test_a_capture_without_data_frames_says_what_it_holds(shared: Path) -> None:
    done = called("check", "--bus-only", shared / "data/can_logs/test_CanErrorFrames.asc")
    assert done.returncode == 0
    assert done.stdout.splitlines() == ["No data frames.", "Left out: error_frame 4"]


def test_real_capture_is_timed_frame_by_frame(shared: Path) -> None:
    capture = shared / "data" / "can_j1939"
    done = called(
        "check", "--bus-only", capture / "vehicle.mf4", "--dbc", capture / "j1939.dbc", "--json"
    )
    report = json.loads(done.stdout)
    assert (report["frames"], len({one["can_id"] for one in report["timing"]})) == (150_411, 67)
    worst_s = [one["timing"]["worst_s"] for one in report["timing"]]
    assert any(2.0 < (worst or 0) < 2.03 for worst in worst_s)


@pytest.mark.slow
def test_rig_passes_and_its_sensors_are_as_told(shared: Path) -> None:
    example = ROOT / "rtid" / "project" / "examples" / "cylinder.toml"
    done = called("check", example, shared / "data/rig/measured/rig_01.parquet", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    noise = {one["name"]: one["noise"] for one in report["signals"]}
    assert noise["p_a"] == pytest.approx(5e3, rel=0.03)
    assert noise["x"] == pytest.approx(1e-5, rel=0.05)
    assert not report["findings"]


def jumping(seed: int) -> tuple[Machine, Samples]:
    """100 rows a second of chamber a under a joystick's steps, its spool 3 ms behind.

    It carries less the faster it goes out, as where a load helps: pressure falls at each jump up.
    """
    model, rng = declared_model(SimulatedPlant()), np.random.default_rng(seed)
    chamber, n, dt_s, tau_s = model.chambers[0], 60_000, 1e-3, 3e-3
    u = np.repeat(rng.uniform(2.0, 10.0, n // 100) * np.resize([1.0, -1.0], n // 100), 100)
    spool = lfilter([dt_s / tau_s], [1.0, dt_s / tau_s - 1.0], u)
    p = 6e6 - 1e5 * spool + 1e6 * np.sin(2.0 * np.pi * 1.3 * dt_s * np.arange(n))
    volume, drop = chamber.volume(np.full(n, 0.45)), np.where(spool > 0.0, 14e6 - p, p)
    stored = volume / 1e9 * np.diff(p, prepend=p[0])
    swept = 3e-8 * spool * np.sqrt(drop) * dt_s - stored
    known = {"u": u, "p_a": p, "p_b": p, "x": 0.4 + np.cumsum(swept) / chamber.area_m2}
    known["p_supply"], names = np.full(n, 14e6), tuple(s.name for s in model.signals)
    values = np.stack([known.get(name, np.zeros(n)) for name in names], axis=1)
    return model, every(Samples(names, 1000 * np.arange(n), values, np.full(n, ROW, np.uint8)), 10)


@pytest.mark.parametrize("seed", range(3))
def test_while_a_spool_is_behind_a_jump_no_sign_is_told(seed: int) -> None:
    """A healthy machine's pressures were swapped at 100 rows a second, and it was `unknown`."""
    spring = motion(*jumping(seed)).springs["a"]
    assert spring.t > 30.0 and 0.5e9 < spring.beta_pa < 2e9
