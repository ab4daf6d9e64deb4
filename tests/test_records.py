"""Several records in one fit: each with its own start and neutral, some held out as a whole."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import savgol_filter

from rtid.errors import RtidError
from rtid.estimator.chunk import to_chunk
from rtid.plain import FloatArray
from rtid.project import ProjectError, load
from rtid.study.quick import quick
from rtid.study.quick_rate import QuickRate
from rtid.study.state_run import run_error
from rtid.study.study import Study
from tests.replays import shared_replays  # noqa: F401
from tests.test_rate import Crane, said

STRANGERS = Path(__file__).parents[2] / "shared/data/strangers"
SESSIONS = "manual_1016_1735", "manual_1016_1720", "manual_mitch_1101_2319", "manual_ol_1006_1648"


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> tuple[Crane, list[Path], Path]:
    """A crane on three days, its radio trimmed anew on each, and the project of the first."""
    folder, rng = tmp_path_factory.mktemp("days"), np.random.default_rng(30)
    crane, tables = Crane.drawn(rng), []
    for k, moved in enumerate((0.0, 2.5, -1.5)):
        today = Crane(**(vars(crane) | {"neutral": round(crane.neutral + moved, 2)}))
        tables.append(today.recorded(folder / f"day{k}.csv", rng, seconds=110.0))
    said("init", tables[0], "-o", folder / "jib.toml")
    text = (folder / "jib.toml").read_text().partition("[record]")[0]
    (folder / "jib.toml").write_text(text + '[record]\nheld_out = ["*2.csv"]\n')
    return crane, tables, folder / "jib.toml"


def test_two_days_teach_and_the_third_judges(days: tuple[Crane, list[Path], Path]) -> None:
    crane, tables, project = days
    study = Study(project, [tables[2], *tables[:2]])
    assert [span.path for span in study.records] == tables, "those held out stand last"
    assert [span.is_held_out for span in study.records] == [False, False, True]
    taught, judging = study.spans
    assert len(taught) + len(judging) == len(study.trace.samples)
    (found,) = study.diagnosis().found
    assert found.effect == "input_delay"
    assert found.parameters["delay"].value == pytest.approx(crane.delay_s, abs=0.03)
    said("add", f"{found.effect}:command", *tables, "-p", project, "--force")
    learned = Study(project, tables)
    w = np.linspace(-5, 5, 41)
    error = 1e3 * learned.map["f"].flow(w, np.zeros(len(w))) - crane.rate(w)
    assert np.sqrt(np.mean(error**2)) < 0.03 * np.abs(crane.rate(w)).max()
    assert [e.path for e in learned.record_errors] == tables
    assert max(e.left / e.flow for e in learned.record_errors) < 0.25
    said("undo", "-p", project)


def test_more_records_tell_more(days: tuple[Crane, list[Path], Path]) -> None:
    """Two days know the map better than one: no block's interval gets wider, most narrower."""
    _, tables, project = days
    both, alone = (Study(project, t).map["f"] for t in (tables, [tables[0], tables[2]]))
    w = np.linspace(-4, 4, 33)
    ratio = both.sd(w, np.zeros(33)) / alone.sd(w, np.zeros(33))
    assert np.median(ratio) < 0.85


def test_commands_tell_the_error_of_each_record(days: tuple[Crane, list[Path], Path]) -> None:
    _, tables, project = days
    words = said("replay", *tables, "-p", project)
    assert all(table.name in words for table in tables) and words.count("held out") == 1
    assert said("compare", *tables, "-p", project).count("taught") == 2
    told = json.loads(said("diagnose", *tables, "-p", project, "--json"))
    assert [r["held_out"] for r in told["records"]] == [False, False, True]
    assert "one record at a time" in said(
        "compare", *tables, "-p", project, "--against", tables[0], code=2
    )


def test_the_project_names_records(days: tuple[Crane, list[Path], Path]) -> None:
    """The same fit, whether they are given or named; one that is both counts once."""
    _, tables, project = days
    named = project.with_name("named.toml")
    records = 'records = ["day0.csv", "day1.csv"]\nheld_out'
    named.write_text(project.read_text().replace("held_out", records))
    given, by_name = Study(project, tables), Study(named, [tables[2], tables[0]])
    assert [s.path.name for s in by_name.records] == [t.name for t in tables]
    np.testing.assert_array_equal(given.taught, by_name.taught)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"*2.csv"', '"night*"', "no record is called 'night*'"),
        ('"*2.csv"', '"*.csv"', "none teaches"),
        ("[record]", "[record]\nidentification_s = [0, 9]", "cuts one record into parts"),
    ],
)
def test_what_cannot_be_is_said(
    days: tuple[Crane, list[Path], Path], old: str, new: str, words: str
) -> None:
    _, tables, project = days
    wrong = project.with_name("wrong.toml")
    wrong.write_text(project.read_text().replace(old, new))
    with pytest.raises(RtidError, match=words.replace("*", r"\*")):
        Study(wrong, tables)


def test_a_record_that_is_not_there_is_said_with_its_place(
    days: tuple[Crane, list[Path], Path],
) -> None:
    wrong = days[2].with_name("lost.toml")
    wrong.write_text(days[2].read_text().replace("held_out", 'records = ["lost.csv"]\nheld_out'))
    with pytest.raises(ProjectError, match=r"lost\.csv"):
        load(wrong)


def test_quick_takes_several_records(days: tuple[Crane, list[Path], Path], tmp_path: Path) -> None:
    """One command from tables to the file of them all; a logger that was set to cm on a day too."""
    crane, (first, second, last), _ = days
    rows = [line.split(",") for line in second.read_text().splitlines()[1:]]
    in_cm = "\n".join(f"{t},{u},{float(x) / 10:.2f}" for t, u, x in rows)
    other = tmp_path / "other.csv"
    other.write_text(f"t_ms,u_jib_pct,x_jib_cm\n{in_cm}\n")
    file = tmp_path / "jib.toml"
    words = said("quick", first, last, other, "--held-out", "day2*", "--save", file)
    neutrals = words.partition("found anew: ")[2].split(" %")[0].split(", ")
    expected = [crane.neutral, crane.neutral - 1.5, crane.neutral + 2.5]
    assert [float(n) for n in neutrals] == pytest.approx(expected, abs=0.02)
    assert words.count("held out") == 1 and words.count("taught") == 2
    study = Study(file, first)
    assert [span.path.name for span in study.records] == [first.name, other.name, last.name]
    assert max(e.left / e.flow for e in study.record_errors) < 0.25
    delay = study.project.sections.added[0].parameters["delay"].value
    assert delay < crane.delay_s < delay + 0.05, "what a held command hides is said"
    assert f"the delay is {1e3 * delay:.0f} to " in said("diagnose", first, "-p", file) + words


def rate_errors(study: Study) -> list[float]:
    """Of each record, the model's rate beside the measured one's Savitzky-Golay, 20 Hz, rms, m/s.

    9 points, 2nd order, of what was measured alone; the model's state runs free.
    """
    chunk, column = to_chunk(study.machine, study.trace.samples, 0), study.machine.position
    errors = []
    for span in study.records:
        part = chunk[(chunk[:, 0] >= span.start_s) & (chunk[:, 0] <= span.end_s)]
        x = part[:, 2 + study.machine.column(column)]
        off = run_error(study.fitted, study.map, part)
        gaps = np.flatnonzero(np.diff(part[:, 0]) > 0.5) + 1
        pieces = zip(*(np.split(v, gaps) for v in (part[:, 0], x, x - off)), strict=True)
        rest = [_rate_off(t, seen, model) for t, seen, model in pieces if len(t) > 40]
        errors.append(float(np.sqrt(np.mean(np.concatenate(rest) ** 2))))
    return errors


def _rate_off(t_s: FloatArray, seen: FloatArray, model: FloatArray) -> FloatArray:
    at = np.arange(t_s[0], t_s[-1], 0.05)
    smooth = savgol_filter(np.interp(at, t_s, seen), 9, 2, deriv=1, delta=0.05)
    return np.asarray(smooth - np.gradient(np.interp(at, t_s, model), 0.05))


@pytest.mark.skipif(not STRANGERS.is_dir(), reason="no measurements of others beside this tree")
def test_a_delay_is_looked_for_that_a_bent_map_hides() -> None:
    """Its first order told nothing there: gains of 9 and 12 mm/s per %, and `matches`."""
    looked = quick(STRANGERS / f"excavator_{SESSIONS[2]}.csv")
    assert isinstance(looked, QuickRate)
    (delay,) = looked.diagnosis.found
    assert "input_delay" in (delay.effect, *delay.cannot_be_told_from) and delay.where == "command"
    band = looked.bands["f"]
    assert -1.3 < band.low < -0.8 and 1.0 < band.high < 1.5
    assert min(band.gain_below, band.gain_above) > 15e-3


@pytest.mark.first_of(1)
@pytest.mark.slow
@pytest.mark.skipif(not STRANGERS.is_dir(), reason="no measurements of others beside this tree")
@pytest.mark.parametrize(
    ("what", "own", "others", "late_ms"), [("boom", 1.55, 1.55, 112), ("stick", 2.4, 3.3, 100)]
)
def test_an_excavator_s_other_days(
    what: str, own: float, others: float, late_ms: float, tmp_path: Path
) -> None:
    """One session teaches, three judge, each with its own neutral; rates in mm/s."""
    tables = [STRANGERS / f"excavator_{name}.csv" for name in SESSIONS]
    held_out = [word for t in tables[1:] for word in ("--held-out", t.name)]
    roles = "--role", f"u=u_{what}_pct", "--role", f"x=x_{what}_cm"
    file = tmp_path / "jib.toml"
    words = said("quick", *tables, *roles, *held_out, "--save", file)
    late = float(words.partition(" ms on average")[0].rpartition(" ")[2])
    assert "delay and lag together are" in words and late == pytest.approx(late_ms, abs=2)
    errors = [1e3 * error for error in rate_errors(Study(file, tables))]
    print(what, errors)
    assert errors[0] < own and max(errors[1:]) < others
