"""`rtid quick`: roles, signs and sizes guessed, data judged, verdicts on simulated records."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_bridge.catalog import CONTROLLER_DBC
from firmware_bridge.sources import read_table
from rtid.cli.exits import Exit
from rtid.daemon.daemon import Bus, Daemon
from rtid.maps.flashed import read_flashed
from rtid.project import load
from rtid.sim.hidden import hide_wish
from rtid.sim.random_plants import draw
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study import quick as studies
from rtid.study.on_board import on_board
from rtid.study.study import Study
from tests.command import called, ends, in_json
from tests.replays import shared_replays  # noqa: F401

LEAK, TRUTH = "internal_leakage_laminar", 2e-12
TWICE = ("--bore", 100, "--rod", 70)  # of what is assumed
STILL = pytest.mark.xfail(
    strict=True,
    reason="insufficient_data: a position five times as noisy at rest leaves 4.2 times the floor",
)
WIRED = ("chambers", "x", "u", "units")
SIZES = ("--bore", 50, "--rod", 36, "--stroke", 500, "--dead-volume", 0.6)


def quick(*arguments: object) -> subprocess.CompletedProcess[str]:
    return called("quick", *arguments)


@cache
def told(*arguments: object) -> Any:
    return in_json("quick", *arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A leaking machine on the bus and as a table, and a clean one."""
    path = tmp_path_factory.mktemp("quick")
    leaking = simulate(hide_wish(SimulatedPlant(), f"{LEAK}=middle"), "rich", 5, 24.0)
    write_run(path / "leak.blf", leaking, 5, "rich")
    write_run(path / "leak.parquet", leaking, 5, "rich")
    write_run(path / "clean.parquet", simulate(SimulatedPlant(), "rich", 6, 45.0), 6, "rich")
    return path


@cache
def columns(table: Path) -> dict[str, np.ndarray]:
    return read_table(table).columns


def sizes_of(plant: SimulatedPlant) -> tuple[object, ...]:
    """What its user knows of a machine, as words of a command line."""
    c = plant.constants
    bore_m = np.sqrt(4 / np.pi * c.area_a_m2)
    rod_m = np.sqrt(bore_m**2 - 4 / np.pi * c.area_b_m2)
    volumes = f"{1e3 * c.v0_a_m3:.6f},{1e3 * c.v0_b_m3:.6f}"
    mm = ("--bore", 1e3 * bore_m, "--rod", 1e3 * rod_m, "--stroke", 1e3 * c.stroke_m)
    return *mm, "--dead-volume", volumes, "--lag", 1.3


def as_csv(path: Path, **values: np.ndarray) -> Path:
    rows = np.column_stack(list(values.values()))
    header = ",".join(values).replace("_of_", " [").replace("__", "]")
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=header, comments="")
    return path


@pytest.mark.parametrize("name", [pytest.param("leak.blf", marks=pytest.mark.long), "leak.parquet"])
def test_a_leak_is_named_from_the_file_alone(folder: Path, name: str) -> None:
    found = told(folder / name)
    assert set(found["roles"]) == {"p_supply", "p_tank", "p_a", "p_b", "x", "v", "u"}
    diagnosis = found["diagnosis"]
    assert diagnosis["verdict"] == "missing"
    (effect,) = diagnosis["found"]
    assert (effect["effect"], effect["where"]) == (LEAK, "a-b")
    assert effect["parameters"]["coefficient"]["value"] == pytest.approx(TRUTH, rel=0.2)
    assert found["data"]["level"] in ("good", "fair")
    assert len(found["cautions"]) == 1 and "--bore" in found["cautions"][0]


def test_a_clean_machine_misses_nothing_in_plain_sentences(folder: Path) -> None:
    done = quick(folder / "clean.parquet")
    assert done.returncode == Exit.OK, done.stdout + done.stderr
    text = done.stdout
    assert "Verdict: matches." in text
    assert "the bore is 50 mm (--bore): else every flow" in text
    assert "Is this data good enough?" in text
    assert "s with 1000 positions per second" in text
    assert f"Next: rtid quick {folder / 'clean.parquet'} --save machine.toml" in text
    volumes = text.partition("Dead volumes, as fitted: ")[2].split()
    assert [float(volumes[0]), float(volumes[5])] == pytest.approx([0.6, 0.6], rel=0.1)


def test_what_a_record_misses_is_a_reservation(folder: Path, tmp_path: Path) -> None:
    names = ("t", "u", "x", "p_a", "p_b", "p_supply")
    every = {name: columns(folder / "clean.parquet")[name] for name in names}
    at = np.arange(len(every["t"]))
    kept = ((at < 9000) | (at >= 13_500)) & ((at < 20_000) | (at >= 24_500))
    path = as_csv(tmp_path / "t.csv", **{name: column[kept] for name, column in every.items()})
    told_of = [
        line for line in quick(path).stdout.splitlines() if "gap" in line or "steps ex" in line
    ]
    assert told_of == [
        "  ~ t.csv: 2 of 36000 steps exceed 1.5 periods, at worst 4501 ms: 20 % of the record is "
        "missing"
    ]


@pytest.mark.long
def test_an_area_only_scales(folder: Path) -> None:
    """Twice the bore: four times the leak, the same verdict."""
    one, two = told(folder / "leak.parquet"), told(folder / "leak.parquet", *TWICE)
    sizes = [d["diagnosis"]["found"][0]["parameters"]["coefficient"]["value"] for d in (one, two)]
    assert sizes[1] / sizes[0] == pytest.approx(4.0, rel=0.01)
    assert one["diagnosis"]["verdict"] == two["diagnosis"]["verdict"] == "missing"


def test_what_is_given_is_not_assumed(folder: Path) -> None:
    found = told(folder / "clean.parquet", *SIZES)
    said = " ".join(a["what"] for a in found["assumptions"])
    assert not any(option in said for option in SIZES if isinstance(option, str))
    assert found["diagnosis"]["found"] == found["diagnosis"]["added"] == []
    assert found["dead_volumes_m3"] == pytest.approx({"a": 0.6e-3, "b": 0.6e-3})


@pytest.mark.long
def test_the_saved_project_says_the_same_in_every_other_command(
    folder: Path, tmp_path: Path
) -> None:
    """No file edited by hand: what was named, added, exported, with the sizes that were given."""
    trace, project = folder / "leak.parquet", tmp_path / "machine.toml"
    found = told(trace, *SIZES, "--lag", 1.3, "--safe-band", 1, "--save", project)
    assert found["next"] == f"rtid add {trace} -p {project}"
    assert Study(project, trace).diagnosis().as_json() == found["diagnosis"]
    text = project.read_text()
    known = ("# Written by `rtid quick`", "piston_diameter_mm = 50", "stroke_mm = 500", "[record]")
    for line in (*known, "dead_volume_l = 0.6", "safe_band_v = 1.0", "nominal_ms = 1.3"):
        assert line in text
    again = quick(trace, "--save", project)
    assert again.returncode == Exit.USAGE and "exists" in again.stderr
    assert ends("add", trace, "-p", project) == Exit.OK
    assert [s.key for s in load(project).sections.added] == [(LEAK, "a-b")]
    assert ends("check", project, trace) == Exit.OK
    room = ("--bytes", 8000, "--sheet", tmp_path / "sheet.html")
    assert ends("export", trace, tmp_path / "maps.dcm", "-p", project, *room) == Exit.OK
    assert sum(8 + m.flow_m3s.size for m in read_flashed(tmp_path / "maps.dcm")) < 4000
    assert "internal_leakage_laminar" in (tmp_path / "sheet.html").read_text()


def test_what_is_written_is_right_on_board(folder: Path, tmp_path: Path) -> None:
    """The lag is the record's, not the assumed one, and changes nothing on the desk."""
    trace, project = folder / "clean.parquet", tmp_path / "machine.toml"
    found = told(trace, *SIZES, "--save", project)
    lag = load(project).sections.dynamics.spool_lag
    assert lag.nominal_s == 2e-3 and lag.seen_s == pytest.approx(1.3e-3, abs=3e-4)
    assert Study(project, trace).diagnosis().as_json() == found["diagnosis"]
    assert on_board(load(project), lambda _: None).model.lag.nominal_s == lag.seen_s


@pytest.mark.long
def test_a_project_beside_its_database_names_it_as_it_lies_there(
    folder: Path, tmp_path: Path
) -> None:
    dbc = tmp_path / "own.dbc"
    dbc.write_bytes(CONTROLLER_DBC.read_bytes())
    found = quick(folder / "leak.blf", "--dbc", dbc, "--save", tmp_path / "m.toml")
    assert found.returncode == Exit.OK
    assert load(tmp_path / "m.toml").sections.source.dbc == "own.dbc"
    assert f"quick {folder / 'leak.blf'} --dbc" not in found.stdout


@pytest.mark.parametrize("volume", ["0", "a", "1,2,3", "0.5,-1"])
def test_a_volume_that_is_none_is_refused(folder: Path, volume: str) -> None:
    done = quick(folder / "clean.parquet", "--dead-volume", volume)
    assert done.returncode == Exit.USAGE and "volumes" in done.stderr


def wired(folder: Path, tmp_path: Path, what: str) -> Path:
    """The leaking machine's table as somebody else has wired, or written, it."""
    c = columns(folder / "leak.parquet")
    x, u, a, b = c["x"], c["u"], c["p_a"], c["p_b"]
    if what == "x":
        x = 0.5 - x
    if what == "u":
        u = -u
    if what == "chambers":
        a, b = b, a
    if what == "units":
        return as_csv(
            tmp_path / "t.csv", time=c["t"], valve=10 * u, Pos_of_mm__=1e3 * x, P1=a / 1e5,
            P2=b / 1e5, Psys=c["p_supply"] / 1e5,
        )  # fmt: skip
    return as_csv(tmp_path / "t.csv", t=c["t"], u=u, x=x, p_a=a, p_b=b, p_supply=c["p_supply"])


@pytest.mark.parametrize("what", WIRED)
def test_signs_and_units_are_found(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """By the motion, before anything is diagnosed."""
    monkeypatch.setattr(studies, "_likeliest", lambda *of: (None, of[3].machine))
    found = in_json("quick", wired(folder, tmp_path, what), code=Exit.NEGATIVE)
    turned = [a["what"] for a in found["assumptions"] if "the wiring" in a["if_wrong"]]
    assert len(turned) == (what != "units")
    if what == "units":
        units = {role: one["unit"] for role, one in found["roles"].items()}
        assert units == {"p_a": "bar", "p_b": "bar", "p_supply": "bar", "u": "%", "x": "mm"}


def test_a_command_of_4_to_20_ma_is_counted_from_12(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It opened one way alone: "edges.at never opens", and no verdict."""
    monkeypatch.setattr(studies, "_likeliest", lambda *of: (None, of[3].machine))
    c = columns(folder / "leak.parquet")
    named = {name: c[name] for name in ("t", "x", "p_a", "p_b", "p_supply")}
    looked = studies.quick(as_csv(tmp_path / "t.csv", u_of_mA__=12.0 + 0.8 * c["u"], **named))
    assert isinstance(looked, studies.Quick)
    assert looked.level == "fair"
    assert looked.machine.u_zero == pytest.approx(12e-3, abs=0.2e-3)
    assert any("u is counted from 1" in a.what for a in looked.assumptions)
    saved = tmp_path / "machine.toml"
    saved.write_text(looked.text_for(saved), "utf-8")
    u = Study(load(saved), tmp_path / "t.csv").trace.samples.column("u")
    assert u == pytest.approx(0.8e-3 * c["u"], abs=0.2e-3)


def test_a_machine_that_is_off_at_4_ma_is_told_to_be_cut_out(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four fifths of the record: the neutral was 0 mA, and what to do was "command less"."""
    monkeypatch.setattr(studies, "_likeliest", lambda *of: (None, of[3].machine))
    c = {name: values[::4] for name, values in columns(folder / "leak.parquet").items()}
    off, noise = 4 * len(c["t"]), np.random.default_rng(1).normal(0.0, 1e-4, 4 * len(c["t"]))
    named = {name: np.append(c[name][0] * (1 + noise), c[name]) for name in ("x", "p_a", "p_b")}
    u = np.append(np.full(off, 4.0), 12.0 + 0.8 * c["u"])
    table = as_csv(tmp_path / "t.csv", t=0.004 * np.arange(len(u)), u_of_mA__=u, **named)
    looked = studies.quick(table)
    assert isinstance(looked, studies.Quick)
    assert looked.machine.u_zero == pytest.approx(12e-3, abs=0.2e-3)
    (ends,) = (one for one in looked.points if one.text.startswith("u stands at its end"))
    assert "nothing moves" in ends.text and "cut that out" in ends.remedy


@pytest.mark.long
@pytest.mark.parametrize("what", WIRED)
def test_the_verdict_is_that_of_the_machine_as_it_is_wired(
    folder: Path, tmp_path: Path, what: str
) -> None:
    found = told(wired(folder, tmp_path, what))
    assert [e["effect"] for e in found["diagnosis"]["found"]] == [LEAK]


GARBAGE = {
    "noise.blf": b"\x93\x11" * 900,
    "noise.parquet": b"\x93\x11" * 900,
    "noise.csv": bytes(range(256)) * 9,
    "noise.mat": b"\x93\x11" * 900,
    "noise.xyz": b"\x93\x11" * 900,
    "empty.csv": b"",
    "empty.log": b"",
    "roles.csv": b"t,foo,bar\n0,1,2\n1,2,3\n",
    "row.csv": b"t,u,x,p_a,p_b\n0,1,2,3,4\n",
    "time.csv": b"u,x,p_a,p_b\n0,1,2,3\n",
    "nan.csv": b"t,u,x,p_a,p_b\n" + 99 * b"nan,nan,nan,nan,nan\n",
    "angle.csv": b"t,u [V],x [deg],p_a [bar],p_b [bar]\n0,1,2,3,4\n1,2,3,4,5\n",
    "back.csv": b"t,u,x,p_a,p_b\n" + b"".join(b"%d,1,2,3,4\n" % k for k in range(99, 0, -1)),
}


@pytest.mark.parametrize("name", GARBAGE)
def test_garbage_is_refused_in_words(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(GARBAGE[name])
    done = quick(tmp_path / name)
    assert done.returncode == Exit.INPUT
    assert done.stderr.lstrip().startswith("rtid: ")
    assert name in done.stderr


def test_what_is_missing_has_a_name(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(GARBAGE["roles.csv"])
    message = quick(tmp_path / "t.csv").stderr
    for word in ("position of the piston (x)", "command of the valves (u)", "foo [?]"):
        assert word in message


@pytest.mark.long
def test_a_log_that_is_slower_than_the_controller(tmp_path: Path) -> None:
    """A healthy machine at 50 of the controller's 1000 commands a second was `unknown`, at rho 5.

    What was found of the command goes into the project, and says the same there.
    """
    run = simulate(draw(6201, law="mixed"), "sweep_record", 6201, 60.0)
    units = {"u": "V", "x": "m"} | dict.fromkeys(("p_a", "p_b", "p_supply", "p_tank"), "Pa")
    every = {f"{n}_of_{u}__": run.samples.column(n)[::20] for n, u in units.items()}
    file = as_csv(tmp_path / "t.csv", t=1e-6 * run.samples.t_us[::20], **every)
    document = told(file, *sizes_of(run.plant), "--save", tmp_path / "m.toml")
    assert document["diagnosis"]["verdict"] == "matches"
    assert any("sample of a faster one" in a["what"] for a in document["assumptions"])
    project = load(tmp_path / "m.toml")
    command = project.sections.signals["u"]
    assert command.hold == "linear"
    study = Study(project, file)
    assert study.diagnosis().verdict == "matches"
    assert study.diagnosis().rho_before == pytest.approx(document["diagnosis"]["rho_before"])


@pytest.mark.parametrize(
    ("still", "words"),
    [
        ("x", "x never changes"),
        ("u", "u never changes"),
        ("p_b", "p_b never changes"),
        ("", "too little"),
        ("way", "never opens"),
    ],
)
def test_data_that_cannot_bear_a_verdict_end_with_4(
    folder: Path, tmp_path: Path, still: str, words: str
) -> None:
    """A signal that stands still, five seconds of record, motion one way."""
    c = columns(folder / "clean.parquet")
    end = 20_000 if still else 5_000
    values = {k: c[k][:end:4].copy() for k in ("t", "u", "x", "p_a", "p_b")}
    if still in values:
        values[still][:] = values[still][0]
    if still == "way":
        values["u"] = np.abs(values["u"])
    done = quick(as_csv(tmp_path / "t.csv", **values))
    assert done.returncode == Exit.NEGATIVE, done.stderr
    assert words in done.stdout
    assert "No verdict" in done.stdout


def test_a_time_in_ms_that_does_not_say_so_is_asked_for(folder: Path, tmp_path: Path) -> None:
    """24 s were 24,000, and too little: "record a minute or two"."""
    c = {name: values[::4] for name, values in columns(folder / "leak.parquet").items()}
    named = {name: c[name] for name in ("u", "x", "p_a", "p_b")}
    looked = studies.quick(as_csv(tmp_path / "t.csv", time=1e3 * c["t"], **named))
    assert isinstance(looked, studies.Quick)
    assert 'name the unit of its time, "t [ms]"' in looked.points[0].remedy


@pytest.mark.long
@pytest.mark.parametrize("is_noisy", [False, pytest.param(True, marks=STILL)])
def test_a_machine_that_rests_at_the_end_is_judged_by_the_end_of_its_motion(
    folder: Path, tmp_path: Path, is_noisy: bool
) -> None:
    c = columns(folder / "clean.parquet")
    values = {k: c[k].copy() for k in ("t", "u", "x", "p_a", "p_b", "p_supply")}
    begin, rng = int(0.75 * len(c["t"])), np.random.default_rng(0)
    values["u"][begin:] = 0.0
    for name, sd in (("x", 5e-5), ("p_a", 1e4), ("p_b", 1e4)):
        values[name][begin:] = values[name][begin]
        quiet = 1.0 if is_noisy else 1e-6
        values[name][begin:] += quiet * sd * rng.standard_normal(len(c["t"]) - begin)
    path, project = as_csv(tmp_path / "t.csv", **values), tmp_path / "m.toml"
    diagnosis = told(path, "--save", project)["diagnosis"]
    assert diagnosis["held_out_judged"] and not diagnosis["found"]
    assert diagnosis["verdict"] == "matches"
    split, end = load(project).sections.record.validation_s or (0.0, 0.0)
    assert 15.0 < split < c["t"][begin] < end


def test_a_log_without_data_frames_says_what_it_holds(tmp_path: Path) -> None:
    log = tmp_path / "remote.log"
    log.write_text("".join(f"({k}.0) can0 123#R\n" for k in range(50)))
    done = quick(log)
    assert done.returncode == Exit.INPUT
    assert "holds no data frames; refused: remote_frame 50" in done.stderr
    assert "DBC" not in done.stderr and "--bus-only" in done.stderr


def test_a_foreign_bus_needs_its_dbc(folder: Path, tmp_path: Path) -> None:
    log = tmp_path / "other.log"
    log.write_text("".join(f"({k}.0) can0 6AB#0011223344556677\n" for k in range(50)))
    done = quick(log)
    assert done.returncode == Exit.INPUT
    assert "0x6AB" in done.stderr and "--dbc" in done.stderr
    assert quick(log, "--dbc", folder / "none.dbc").returncode == Exit.INPUT
    assert quick(folder / "leak.blf", "--bore", 30, "--rod", 40).returncode == Exit.USAGE


@pytest.mark.long
def test_a_saved_project_runs_on_board_as_it_is(folder: Path, tmp_path: Path) -> None:
    """Whoever follows `Next:` from a log to the machine edits no file by hand."""
    project = tmp_path / "p.toml"
    assert quick(folder / "leak.parquet", "--save", project).returncode == Exit.OK
    loaded = load(project)
    noise = {signal.name: signal.noise for signal in loaded.model.signals}
    assert loaded.noise_unknown and not loaded.noise_unseen
    assert noise["p_a"] == pytest.approx(5e3, rel=0.05), "of the simulated sensor, Pa"
    Daemon(loaded, Bus("virtual", "x", lambda: pytest.fail("opened")), tmp_path)
    board = on_board(loaded, lambda _: None)
    chambers = zip(board.model.chambers, loaded.model.chambers, strict=True)
    assert all(fitted.v0_m3 > assumed.v0_m3 for fitted, assumed in chambers)
    desk, first = Study(project, folder / "leak.parquet"), told(folder / "leak.parquet")
    (named,) = desk.diagnosis().found
    size = first["diagnosis"]["found"][0]["parameters"]["coefficient"]
    assert named.parameters["coefficient"].value == pytest.approx(size["value"], rel=1e-6)
    assert named.parameters["coefficient"].std == pytest.approx(size["std"], rel=1e-6)


@pytest.mark.long
def test_a_supply_that_nobody_measures_is_asked_for_first(folder: Path, tmp_path: Path) -> None:
    """A record without one was `unknown`, and the safe band the first to be looked at."""
    values = {name: v for name, v in columns(folder / "leak.parquet").items() if name != "p_supply"}
    table = as_csv(tmp_path / "no_supply.csv", **values)
    silent = told(table)
    assert silent["assumptions"][0]["what"].endswith("MPa (--supply)")
    assert "the supply's pressure" in silent["cautions"][0]
    points = [point["text"] for point in silent["data"]["points"]]
    assert not any("stays within" in text for text in points), "of a figure that was assumed"
    project = tmp_path / "said.toml"
    # it swings from 6.4 to 8.4: neither what is missing nor that nothing is can be told
    said = in_json("quick", table, "--supply", 7, "--save", project, code=Exit.NEGATIVE)
    assert said["diagnosis"]["verdict"] == "insufficient_data"
    assert not any("supply" in a["what"] for a in said["assumptions"])
    assert load(project).sections.signals["p_supply"].constant == 7e6
    remedies = ["".join(point["remedy"] for point in d["data"]["points"]) for d in (silent, said)]
    assert ["--supply" in text for text in remedies] == [True, False], "once is enough"


def test_a_supply_is_measured_or_said(folder: Path) -> None:
    refused = quick(folder / "leak.parquet", "--supply", 7)
    assert refused.returncode == Exit.USAGE and "p_supply measures the supply" in refused.stderr


@pytest.mark.long
def test_several_records_of_a_cylinder_make_one_project(folder: Path, tmp_path: Path) -> None:
    """One was taken, and a section of the file was to be deleted by hand for the others."""
    other, project = tmp_path / "tuesday.parquet", tmp_path / "m.toml"
    leaking = simulate(hide_wish(SimulatedPlant(), f"{LEAK}=middle"), "rich", 8, 30.0)
    write_run(other, leaking, 8, "rich")
    done = quick(folder / "leak.parquet", other, "--save", project)
    assert done.returncode == Exit.OK, done.stderr
    assert "learns from all 2 records" in done.stdout
    assert f"Next: rtid diagnose {folder / 'leak.parquet'} -p {project}" in done.stdout
    assert '"tuesday.parquet"' in project.read_text()
    study = Study(project, other)
    assert [span.path.name for span in study.records] == ["leak.parquet", "tuesday.parquet"]
    assert [span.is_held_out for span in study.records] == [False, True]
    assert [effect.effect for effect in study.diagnosis().found] == [LEAK]
