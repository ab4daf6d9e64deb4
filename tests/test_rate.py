"""Plants without pressures, d x / dt = f(u): random ones through the commands, and strangers'."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from zipfile import ZipFile

import numpy as np
import pytest

from rtid.cli.exits import Exit
from rtid.compare.dead_band import dead_band
from rtid.diagnose.disturbance import with_disturbance
from rtid.estimator.chunk import to_chunk
from rtid.fleet.archive import Archive
from rtid.fleet.merging import FleetMachine, typical, write
from rtid.maps.datasheet import read_reference
from rtid.maps.files import read_map
from rtid.plain import FloatArray
from rtid.project import ProjectError, load
from rtid.study.quick import quick
from rtid.study.quick_rate import QuickRate
from rtid.study.study import Study
from rtid.tell.charts.blocks import quantities
from rtid.tell.charts.maps import flow_plane
from rtid.trace.neutral import neutral_of
from rtid.ui.desk import Desk
from rtid.ui.desk_views import Bench
from rtid.ui.map_view import MapView
from rtid.ui.shared import Session, ShownRevision
from rtid.ui.where_view import WhereView
from rtid.units import flow_name, show_flow_as
from tests.command import called
from tests.replays import shared_replays  # noqa: F401

STRANGERS = Path(__file__).parents[2] / "shared/data/strangers"


@pytest.fixture(autouse=True)
def _shown_as_flows() -> Any:
    """Another test's machine is hydraulic."""
    yield
    show_flow_as("m3/s")


@dataclass(frozen=True)
class Crane:
    """A drive with neutral, dead band, unequal gains and a delay; sizes in %, mm/s per % and s."""

    neutral: float
    low: float
    high: float
    gain_below: float
    gain_above: float
    delay_s: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Crane:
        return cls(
            round(float(rng.uniform(5, 60)), 2), -float(rng.uniform(0.8, 2.0)),
            float(rng.uniform(0.8, 2.0)), float(rng.uniform(4, 9)), float(rng.uniform(4, 9)),
            float(rng.uniform(0.10, 0.2)),
        )  # fmt: skip

    def rate(self, u: FloatArray) -> FloatArray:
        """Speed (n,), mm/s, of commands (n,) about the neutral, %."""
        up, down = np.maximum(0.0, u - self.high), np.minimum(0.0, u - self.low)
        return np.asarray(self.gain_above * up + self.gain_below * down)

    def recorded(self, path: Path, rng: np.random.Generator, seconds: float = 200.0) -> Path:
        """A table at an uneven 20 Hz: the command is held, the position rounded to 0.2 mm."""
        fine = 1e-3 * np.arange(round(1e3 * seconds))
        levels = rng.uniform(-6, 6, len(fine)) * (rng.random(len(fine)) < 0.7)
        u = np.repeat(levels[: len(fine) // 800 + 1], 800)[: len(fine)]
        late = np.interp(fine - self.delay_s, fine, u)
        x = 300 + 1e-3 * np.cumsum(self.rate(late))
        at = np.cumsum(rng.uniform(0.04, 0.06, round(seconds / 0.05)))
        at = at[at < seconds - 1]
        k = np.round(1e3 * at).astype(int)
        measured = np.round((x[k] + 0.1 * rng.standard_normal(len(k))) / 0.2) * 0.2
        rows = zip(fine[k] * 1e3, u[k] + self.neutral, measured, strict=True)
        text = "\n".join(f"{t:.0f},{c:.4f},{p:.1f}" for t, c, p in rows)
        path.write_text(f"t_ms,u_jib_pct,x_jib_mm\n{text}\n")
        return path


def said(*words: object, code: int = Exit.OK) -> str:
    done = called(*words)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rate")


@pytest.fixture(scope="module")
def crane(folder: Path) -> tuple[Crane, Path, Path]:
    """A random drive, its table, and the project that `quick` writes of it."""
    rng = np.random.default_rng(20)
    plant = Crane.drawn(rng)
    table = plant.recorded(folder / "jib.csv", rng)
    project = folder / "jib.toml"
    words = said("quick", table, "-o", project)
    assert "plant without pressures" in words and "Input delay at command" in words
    return plant, table, project


def test_neutral_band_gains_and_delay_are_found(crane: tuple[Crane, Path, Path]) -> None:
    plant, table, project = crane
    study = Study(project, table)
    (delay,) = [added for added in study.fitted.revision.timings]
    print(plant, delay[1])
    assert delay[0].effect == "input_delay"
    assert delay[1][0] == pytest.approx(plant.delay_s, abs=0.03)
    band = dead_band(study.map["f"])
    assert band.low == pytest.approx(plant.low, abs=0.35)
    assert band.high == pytest.approx(plant.high, abs=0.35)
    assert 1e3 * band.gain_above == pytest.approx(plant.gain_above, rel=0.15)
    assert 1e3 * band.gain_below == pytest.approx(plant.gain_below, rel=0.15)
    w = np.linspace(-5, 5, 41)
    q = 1e3 * study.map["f"].flow(w, np.zeros(len(w)))
    assert np.sqrt(np.mean((q - plant.rate(w)) ** 2)) < 0.03 * np.abs(plant.rate(w)).max()


def test_a_position_that_rows_repeat_is_no_delay(tmp_path: Path) -> None:
    """Sent each 40 ms in rows of 10 ms: on the mean it was 15 ms old, and a delay of 15 was named.

    On lines between the instants at which it is sent nothing is late.
    """
    rng, table = np.random.default_rng(20), tmp_path / "jib.csv"
    plant = Crane.drawn(rng)
    fine = 1e-3 * np.arange(200_000)
    u = np.repeat(rng.uniform(-6, 6, 250) * (rng.random(250) < 0.7), 800)
    sent = (np.cumsum(plant.rate(u)) * 1e-3 + 300)[::40] + 0.1 * rng.standard_normal(5000)
    x = np.repeat(np.round(sent / 0.2) * 0.2, 4)
    rows = np.column_stack([1e3 * fine[::10], u[::10] + plant.neutral, x])
    head = "t_ms,u_jib_pct,x_jib_mm"
    np.savetxt(table, rows, "%.7g", ",", header=head, comments="")
    looked = quick(table)
    assert isinstance(looked, QuickRate)
    assert looked.diagnosis.verdict == "matches" and not looked.diagnosis.found


def test_a_rate_is_told_by_where_a_coarse_position_crosses_its_steps(tmp_path: Path) -> None:
    """Of 1 mm at 50 Hz: taken for white noise the steps hid the motion, and nothing was judged."""
    rng, table = np.random.default_rng(20), tmp_path / "jib.csv"
    plant = Crane.drawn(rng)
    u = np.repeat(rng.uniform(-6, 6, 250) * (rng.random(250) < 0.7), 800)
    x = (np.cumsum(plant.rate(u)) * 1e-3 + 300)[::20] + 0.1 * rng.standard_normal(10_000)
    rows = np.column_stack([20.0 * np.arange(10_000), u[::20] + plant.neutral, np.round(x)])
    head = "t_ms,u_jib_pct,x_jib_mm"
    np.savetxt(table, rows, "%.7g", ",", header=head, comments="")
    looked = quick(table)
    assert isinstance(looked, QuickRate) and looked.diagnosis.verdict == "matches"
    assert 1e3 * looked.bands["f"].gain_above == pytest.approx(plant.gain_above, rel=0.05)


def test_every_command_takes_it(crane: tuple[Crane, Path, Path], folder: Path) -> None:
    _, table, project = crane
    assert "Ready to learn" in said("check", project, table)
    replay = said("replay", table, "-p", project)
    assert "mm/s" in replay and "MPa" not in replay and "modulus" not in replay
    assert "L/min" not in said("compare", table, "-p", project)
    told = json.loads(said("diagnose", table, "-p", project, "--json"))
    assert told["verdict"] == "matches" and told["disturbance"] > 0
    assert "what moves the plant beside its command" in said("diagnose", table, "-p", project)
    said("drop", "input_delay", "-p", project)
    bare = json.loads(said("diagnose", table, "-p", project, "--json"))
    assert [found["effect"] for found in bare["found"]] == ["input_delay"]
    found = bare["found"][0]
    assert found["heldout_residual_after_m3s"] < 0.5 * found["heldout_residual_before_m3s"]
    said("undo", "-p", project)
    said("export", table, folder / "jib_map.csv", "-p", project)
    origin, heads, *_ = (folder / "jib_map.csv").read_text().splitlines()
    assert '"flow_unit": "m/s"' in origin
    assert heads == "edge,u_%,over,Q_m/s,sd_m/s,status"
    said("export", table, folder / "jib_map.json", "-p", project)
    units = json.loads((folder / "jib_map.json").read_text())["units"]
    assert units == {"u_v": "%", "dp_pa": "1", "theta_m3s": "m/s", "cov_m6s2": "(m/s)^2"}
    flowmap, sheet = read_map(folder / "jib_map.json")[0], read_reference(folder / "jib_map.csv")
    w = np.linspace(-4, 4, 41)
    flow = flowmap.flow("f", w, np.zeros(41))
    np.testing.assert_allclose(sheet.flow("f", w, np.zeros(41)), flow, atol=0.05 * flow.max())
    said("export", table, folder / "jib_map.fmu", "-p", project, "--map")
    with ZipFile(folder / "jib_map.fmu") as archive:
        assert 'unit="m/s"' in archive.read("modelDescription.xml").decode()


def test_a_typical_map_of_rates_says_its_units(
    crane: tuple[Crane, Path, Path], folder: Path
) -> None:
    _, table, project = crane
    study = Study(project, table)
    alike = [FleetMachine(name, "0" * 16, (), study.fit.solution, study.map) for name in "abc"]
    archive = Archive(folder / "fleet")
    write(archive, [], typical(alike))
    _, heads, *_ = (archive.folder / "typical-00000000.csv").read_text().splitlines()
    assert heads == "edge,u_%,over,Q_m/s,sd_m/s,status"
    assert read_map(archive.folder / "typical-00000000.npz")[1]["command_unit"] == "%"


def texts(root: Any) -> str:
    """All words of a drawn view: titles, labels of axes, and what a pointer tells."""
    figures = [model for model in root.references() if model.__class__.__name__ == "figure"]
    axes = [axis.axis_label or "" for f in figures for axis in (*f.xaxis, *f.yaxis) if axis.visible]
    return " | ".join([*axes, *(f.title.text for f in figures)])


def test_the_page_says_the_units_of_a_rate(crane: tuple[Crane, Path, Path]) -> None:
    """It said V, MPa and mL/min of a command in per cent and a speed, and "f:  →" of the map."""
    _, table, project = crane
    opened = Desk(lambda _text, _share: None).open(project, table, None)
    seen = [ShownRevision(opened.look, ())]
    session = SimpleNamespace(
        seen=seen, revisions=seen, opened=opened, offered=None, trace=table, last=seen[0]
    )
    bench = Bench(cast("Session", session), lambda _key: None, lambda *_span: None)
    where, shown_map = WhereView(bench), MapView(bench)
    for view in (where, shown_map):
        view.refresh()
        said_of = " ".join([*view.fragments().values(), *map(texts, view.roots.values())])
        assert not re.findall(r"MPa|\bV\b|L/min|orifice|→|pressure drop", said_of), said_of
        assert "command in %" in said_of and "mm/s" in said_of
    assert "f of u" in texts(where.roots["maps"])
    assert re.search(r"The block <b>f, \S+ to \S+ %</b> holds", where.fragments()["says"])
    assert set(quantities(1.0)) >= {"residual"} and quantities(1.0)["residual"].unit == "mm/s rms"
    hints = next(iter(where.planes._sources.values())).data
    assert all(re.fullmatch(r"\S+ to \S+ %", words) for words in hints["place"])


def test_the_server_says_the_units_that_its_worker_has_read(
    crane: tuple[Crane, Path, Path],
) -> None:
    """The project is read in another process: charts of the page said L/min all the same."""
    _, table, project = crane
    opened = Desk(lambda _text, _share: None).open(project, table, None)
    show_flow_as("m3/s")
    worker = SimpleNamespace(submit=lambda *_a, **_k: None)
    session = Session(project, table, cast("Any", worker))
    session.ask = lambda *_a, **_k: None  # type: ignore[method-assign]
    session._opened(opened)
    assert quantities(1.0)["residual"].unit == "mm/s rms"
    (edge,), (learned,) = opened.look.model.maps, opened.look.flowmap.edges
    plane = flow_plane(learned, opened.look.model.axes(edge))
    assert plane.low == -plane.high and plane.low <= plane.values.min() < 0  # down and up


def test_the_report_says_the_units_of_a_rate(crane: tuple[Crane, Path, Path], folder: Path) -> None:
    _, table, project = crane
    said("report", table, "-p", project, "-o", folder / "jib.html")
    words = (folder / "jib.html").read_text()
    for wrong in ("opening command in V", "pressure drop", "L/min", " V and "):
        assert wrong not in words
    assert "command in %" in words and "flow in mm/s" in words


def test_neutral_is_found_anew_in_each_record(
    crane: tuple[Crane, Path, Path], folder: Path
) -> None:
    """A radio that was trimmed: another neutral, the same map."""
    plant, _, project = crane
    other = Crane(**(vars(plant) | {"neutral": plant.neutral + 3.0}))
    table = other.recorded(folder / "trimmed.csv", np.random.default_rng(21))
    flowmap = Study(project, table).map["f"]
    w = np.linspace(-5, 5, 41)
    error = 1e3 * flowmap.flow(w, np.zeros(len(w))) - plant.rate(w)
    assert np.sqrt(np.mean(error**2)) < 0.03 * np.abs(plant.rate(w)).max()


def test_init_writes_a_project_that_is_complete(
    crane: tuple[Crane, Path, Path], folder: Path
) -> None:
    _, table, _ = crane
    said("init", table, "-o", folder / "init.toml")
    project = load(folder / "init.toml")
    assert project.model.chambers[0].unit == "m/s" and flow_name() == "mm/s"
    assert "no such signal" in said(
        "init", table, "-o", folder / "n.toml", "--role", "u=job", code=2
    )
    assert "is not ROLE=COLUMN" in said("quick", table, "--role", "u", code=2)


def test_no_disturbance_where_the_sensor_explains_all(folder: Path) -> None:
    """Without delay and rounding, the row's variance is that of the sensor: nothing is added."""
    rng = np.random.default_rng(5)
    plant = Crane(50.0, -1.0, 1.0, 5.0, 5.0, 0.0)
    table = plant.recorded(folder / "clean.csv", rng)
    project = folder / "clean.toml"
    said("init", table, "-o", project)
    study = Study(project, table)
    chunk = to_chunk(study.project.model, study.read.samples, int(study.read.samples.t_us[0]))
    noisy = study.project.model.with_noise({"x": 1.0})
    assert with_disturbance(noisy, chunk).chambers[0].disturbance == 0.0


def test_a_table_of_no_plant_gets_one_page_of_help(folder: Path) -> None:
    """What was seen, what each kind of plant needs, and the command that goes on."""
    table = folder / "oven.csv"
    rng = np.random.default_rng(0)
    rows = (f"{k},{rng.normal():.3f},{rng.normal():.3f}" for k in range(200))
    table.write_text("t_s,force_N,mood\n" + "\n".join(rows) + "\n")
    words = said("quick", table, code=3)
    for what in ("force_N [N]", "mood [?]", "p_a, p_b", "rtid refit", "--role u=COLUMN"):
        assert what in words
    assert "Still missing" in said("init", table, "-o", folder / "oven.toml")


def test_what_does_not_follow_the_command_is_no_plant(folder: Path) -> None:
    rng = np.random.default_rng(1)
    rows = (f"{0.05 * k:.2f},{rng.normal():.3f},{rng.normal():.3f}" for k in range(400))
    table = folder / "noise.csv"
    table.write_text("t_s,u_pct,x_mm\n" + "\n".join(rows) + "\n")
    assert "must follow the command" in said("quick", table, code=3)


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ('state = "x"', 'state = "y"', "rate.state"),
        ('command = "u"', 'command = "x"', "maps.f.command"),
        ("u_grid_pct", "u_grid_v", "maps.f.u_grid_v"),
        ('basis = "blended"', 'over = "x"', "maps.f.over"),
        ("[rate]", "[geometry]\nstroke_mm = 3\n[rate]", "geometry"),
        ('column = "x_jib_mm"', 'column = "x_jib_mm"\noffset = "estimate"', "signals.x.offset"),
    ],
)
def test_errors_name_their_place(
    crane: tuple[Crane, Path, Path], folder: Path, old: str, new: str, place: str
) -> None:
    text = crane[2].read_text()
    assert old in text
    wrong = folder / "wrong.toml"
    wrong.write_text(text.replace(old, new, 1))
    with pytest.raises(ProjectError) as caught:
        load(wrong)
    assert place in [problem.path for problem in caught.value.problems]


def test_neutral_of_a_noisy_command_is_its_median_at_rest() -> None:
    rng = np.random.default_rng(2)
    t_s = 0.01 * np.arange(4000, dtype=np.float64)
    u = np.where(t_s % 8 < 4, 0.0, 2.0) + 5.8
    x = np.cumsum(np.where(u > 6, 0.5, 0.0)) * 0.01
    assert neutral_of(t_s, u, x) == pytest.approx(5.8, abs=1e-12)
    noisy = u + 0.02 * rng.standard_normal(len(u))
    assert neutral_of(t_s, noisy, x) == pytest.approx(5.8, abs=0.01)
    assert np.isnan(neutral_of(t_s[:0], u[:0], x[:0]))


@pytest.mark.skipif(not STRANGERS.is_dir(), reason="the strangers' records are not here")
@pytest.mark.parametrize("what", ["boom", "stick"])
def test_an_excavator_of_strangers(what: str, tmp_path: Path) -> None:
    """Neutral, dead band on both sides and a delay of 0.05 to 0.2 s; unseen motion agrees."""
    table = tmp_path / "session.csv"
    table.write_bytes((STRANGERS / "excavator_manual_1016_1735.csv").read_bytes())
    told = json.loads(said("quick", table, "--role", f"u=u_{what}_pct", "--json"))
    assert told["neutral"] == pytest.approx({"boom": 7.4745, "stick": 6.895}[what], abs=0.03)
    band = told["maps"]["f"]
    assert -2.0 < band["low"] < -0.5 < 0.5 < band["high"] < 2.0
    delay = next(f for f in told["diagnosis"]["found"] if f["effect"] == "input_delay")
    assert 0.05 < delay["parameters"]["delay"]["value"] < 0.2
