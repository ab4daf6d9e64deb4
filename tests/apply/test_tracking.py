"""What a map will do to tracking: told before it is sent, and what the machine then really does."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtid.apply import tracking
from rtid.apply.judge import KnownMap, candidate
from rtid.apply.offer import Offer
from rtid.apply.offer import write as write_offer
from rtid.apply.tracking import (
    FollowedPath,
    NoTrackingError,
    foretell,
    reference_of,
    tracking_error,
)
from rtid.cli import main
from rtid.kernels.control_law import Mechanics
from rtid.plain import FloatArray
from rtid.project import load
from rtid.project.errors import ProjectError
from rtid.project.schema import ControllerSection
from rtid.study.study import Study
from tests.command import ends
from tests.replays import shared_replays  # noqa: F401
from tests.tracking_machines import KP_1PS, Tried, follow, logged, machine, path, rms_m

SECTION = ControllerSection(kp_per_s=KP_1PS, reference="x_ref")
SECONDS = 8.0


pytestmark = pytest.mark.long  # machines are driven and learned for it


@pytest.fixture(scope="module")
def tried() -> Tried:
    return machine(3, 30.0)


def rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(error[len(error) // 2 :] ** 2)))


def mechanics(tried: Tried) -> Mechanics:
    return tracking._mechanics(tried.model, tried.plant.constants.stroke_m, SECTION)


def ramp(tried: Tried, speed_mps: float, seconds: float = 2.0) -> FollowedPath:
    """A steady motion against the load of mid-stroke."""
    t = np.arange(0.0, seconds, 1e-3)
    c, model = tried.plant.constants, tried.model
    p_b = 1.2e6
    p_a = (c.gravity_n + p_b * c.area_b_m2) / c.area_a_m2
    values = {"p_a": p_a, "p_b": p_b, "p_supply": 7e6, "p_tank": 1e5, "x": 0.2}
    columns = [np.full_like(t, values.get(s.name, 0.0)) for s in model.signals]
    flat = np.zeros_like(t)
    route = np.stack([0.2 + speed_mps * t, flat + speed_mps, flat, flat], axis=1)
    samples = np.column_stack([t, np.full_like(t, 1.0), *columns])
    return FollowedPath("ramp", samples, route, np.full_like(t, c.gravity_n), None)


@pytest.mark.parametrize("speed_mps", [0.04, -0.03])
def test_a_map_that_is_wrong_by_a_tenth_is_behind_by_a_tenth_of_the_speed(
    tried: Tried, speed_mps: float
) -> None:
    """A v = Q(u) and Q_held(u) = A (v_d + k e), Q = Q_held / 0.9: v = v_d where k e = -0.1 v_d."""
    steady = ramp(tried, speed_mps)
    quiet = replace(tried.model, signals=tuple(replace(s, noise=0.0) for s in tried.model.signals))
    missed, noise = np.zeros((len(steady.samples) - 1, 2)), np.zeros((len(steady.samples), 8))
    known = candidate(quiet, tried.learned)
    wrong = {k: replace(t, scale=0.9 * t.scale) for k, t in tried.new.items()}
    of = [
        rms(tracking_error(quiet, SECTION, mechanics(tried), known, tables, steady, missed, noise))
        for tables in (tried.new, wrong)
    ]
    assert of[0] < 0.02 * abs(speed_mps) / KP_1PS
    assert of[1] == pytest.approx(0.1 * abs(speed_mps) / KP_1PS, rel=0.05)


def test_the_machine_then_does_what_was_foretold(tried: Tried) -> None:
    """On a motion that nobody has learned from; the record was made with the held map."""
    ref = path(tried.plant, SECONDS, 3)
    chunk = logged(tried, follow(tried.plant, tried.held, ref, 1)[1], ref)
    stroke_m = tried.plant.constants.stroke_m
    told = foretell(
        tried.model, stroke_m, SECTION, chunk, tried.learned, tried.beta_sd_pa, tried.new,
        tried.held,
    )  # fmt: skip
    assert told.held is not None and told.recorded_m is not None
    for tables, interval, seed in ((tried.held, told.held, 2), (tried.new, told.new, 3)):
        really = rms_m(follow(tried.plant, tables, ref, seed)[0], ref)
        assert interval.low_m < really < interval.high_m
        assert interval.high_m < 1.3 * interval.low_m
    assert told.new.high_m < told.held.low_m
    assert "with the held map" in told.sentence and "recorded" in told.sentence
    assert json.dumps(told.as_json())


def test_the_load_is_what_the_declared_mechanics_do_not_say(tried: Tried) -> None:
    ref = path(tried.plant, SECONDS, 3)
    chunk = logged(tried, follow(tried.plant, tried.held, ref, 1)[1], ref)
    c = tried.plant.constants
    whole = Mechanics(*c[:-1])
    rest = reference_of(tried.model, whole, "x_ref", chunk).load_n[500:]
    assert np.abs(rest).mean() < 0.02 * c.gravity_n
    bare = reference_of(tried.model, whole._replace(mass_kg=0.0), None, chunk)
    assert rest.std() < 0.1 * bare.load_n[500:].std()


def test_a_gap_is_left_out_and_too_little_is_refused(tried: Tried) -> None:
    ref = path(tried.plant, SECONDS, 3)
    chunk = logged(tried, follow(tried.plant, tried.held, ref, 1)[1], ref)
    chunk[5000:, 0] += 1.0
    assert len(reference_of(tried.model, mechanics(tried), None, chunk).samples) == 5000
    with pytest.raises(NoTrackingError, match="without a gap"):
        reference_of(tried.model, mechanics(tried), None, chunk[:1000])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"edges": slice(1, 4)}, "no edge moves oil into a"),
        ({"chambers": slice(0, 1), "law": "robust"}, "needs both chambers"),
    ],
)
def test_what_cannot_be_run_is_said(tried: Tried, change: dict[str, Any], says: str) -> None:
    law = change.pop("law", "feedforward")
    fields = {name: getattr(tried.model, name)[part] for name, part in change.items()}
    section = ControllerSection(kp_per_s=5.0, law=law, mass_kg=400.0)
    with pytest.raises(NoTrackingError, match=says):
        foretell(
            replace(tried.model, **fields), 0.5, section, np.zeros((0, 10)), tried.learned,
            tried.beta_sd_pa, tried.new, None,
        )  # fmt: skip


def test_an_interval_contains_what_the_model_got_wrong() -> None:
    """Recorded 1 mm, foretold 2 mm: the held map's is that of the record, the new one's may be."""
    of = [np.log([rms_m] * 16) for rms_m in (2e-3, 1e-3)]
    held = tracking._interval(of[0], -np.log(2), 1e-3)
    new = tracking._interval(of[1], -0.5 * np.log(2), 1e-3)
    assert held.rms_m == pytest.approx(1e-3) and held.low_m < 1e-3 < held.high_m
    assert new.low_m < 0.5e-3 and new.high_m > 1e-3
    plain = tracking._interval(of[1], 0.0, 0.0)
    assert tracking._interval(of[1], 0.0, 10.0).low_m == 0.0
    some = np.append(np.log([1e-3] * 13), [np.inf] * 3)
    assert tracking._interval(some, 0.0, 0.0) == plain
    with pytest.raises(NoTrackingError, match="runs away in 5 of 16"):
        tracking._refuse_runaways("held", 5)
    assert [plain.rms_m, plain.low_m, plain.high_m] == pytest.approx(
        [1e-3, 1e-3 / 1.0435, 1.0435e-3], rel=1e-3
    )


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with a controller and a way to it, its trace beside it, and an offer."""
    folder = tmp_path_factory.mktemp("tracking")
    trace = folder / "run.blf"
    ends("simulate", trace, "--duration", "12", "--motion", "rich")
    file = folder / "run.toml"
    text = file.read_text("utf-8")
    file.write_text(
        text + "\n[publish]\ncan_id = 0x700\nreply_id = 0x701\nerror_percent = 1\n"
        "\n[controller]\nkp_per_s = 8\n",
        "utf-8",
    )
    study = Study(load(file), trace)
    known = KnownMap(study.map, study.fit.solution.beta_pa)
    judgement = {
        "blocks": 25, "new_m3s": 1e-6, "held_m3s": 2e-6, "against": "no map",
        "gain_percent": 50.0, "t": 9.0,
    }  # fmt: skip
    (folder / "run.state").mkdir()
    sd_pa = study.fit.solution.beta_sd_pa
    write_offer(folder / "run.state", Offer(known, sd_pa, None, judgement, {}, 0.0))
    return file


def applied(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert ends("apply", *arguments, "--dry-run") == 0
    return capsys.readouterr().out


def test_a_dry_run_tells_it_before_anything_is_sent(
    simulated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "--against TRACE" in applied(capsys, str(simulated))
    trace = str(simulated.with_suffix(".blf"))
    assert "rms tracking error over 12 s of the recorded motion" in " ".join(
        applied(capsys, str(simulated), "--against", trace).split()
    )
    told = json.loads(applied(capsys, str(simulated), "--against", trace, "--json"))["tracking"]
    assert told["held"] is None and 0 < told["new"]["low_m"] < told["new"]["high_m"] < 0.01


def test_the_report_tells_it_too(simulated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = simulated.with_name("report.html")
    with pytest.raises(SystemExit) as ended:
        trace = str(simulated.with_suffix(".blf"))
        main.run(["report", trace, "-p", str(simulated), "--output", str(page)])
    assert ended.value.code == 0, capsys.readouterr().err
    text = page.read_text("utf-8")
    assert "<h2>Tracking</h2>" in text and "rms tracking error over" in text


def test_without_a_controller_nothing_is_said(
    simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = simulated.read_text("utf-8").partition("[controller]")[0]
    bare = simulated.with_name("bare.toml")
    bare.write_text(text, "utf-8")
    state = str(simulated.with_name("run.state"))
    told = json.loads(applied(capsys, str(bare), "--state", state, "--json"))
    assert told["tracking"] is None


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ('kp_per_s = 5\nlaw = "robust"', "controller.mass_kg"),
        ('kp_per_s = 5\nreference = "p_a"', "is no position signal"),
        ("kp_per_s = 0", "controller.kp_per_s"),
    ],
)
def test_a_wrong_section_is_named(simulated: Path, lines: str, says: str) -> None:
    text = simulated.read_text("utf-8").partition("[controller]")[0]
    wrong = simulated.with_name("wrong.toml")
    wrong.write_text(f"{text}[controller]\n{lines}\n", "utf-8")
    with pytest.raises(ProjectError, match=says):
        load(wrong)
