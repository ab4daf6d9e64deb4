"""Add, drop, undo: the whole cycle on simulated records, from the diagnosis and back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shutil import copy
from types import SimpleNamespace
from typing import Any

import pytest

import rtid
from rtid.cli.exits import Exit
from rtid.diagnose.extend import RefusedError
from rtid.diagnose.fit import prepare
from rtid.diagnose.parts import AddedEffect, PartError, recall
from rtid.effects import EffectError
from rtid.effects.laws.timing import COMMAND
from rtid.project import load
from rtid.project.history import history, path_of
from rtid.sim.hidden import hide_wish
from rtid.sim.recording import write_run
from rtid.sim.run import simulate
from rtid.sim.simulated_plant import SimulatedPlant
from rtid.study.revisions import add, drop, undo
from rtid.study.spans import parts
from rtid.study.study import diagnose_trace
from rtid.trace.reading import Trace, read_trace
from tests.command import ends, in_json
from tests.replays import shared_replays  # noqa: F401

LEAK, WRONG = "internal_leakage_laminar", "position_sensor_delay"
DRIFT = "valve_gain_drift"  # of either sign: what is next to nothing is never impossible
TRUTH = 2e-12  # m3/s/Pa, of the middle strength


def recorded(folder: Path, wish: str, duration_s: float) -> Path:
    """A record with something hidden; its project file, with a comment of the user."""
    trace = folder / "trace.parquet"
    write_run(trace, simulate(hide_wish(SimulatedPlant(), wish), "rich", 0, duration_s), 0, "rich")
    project = folder / "trace.toml"
    project.write_text(project.read_text() + "# the pump was changed in May\n")
    return project


@pytest.fixture(scope="module")
def leaking(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("leak"), f"{LEAK}=middle", 40.0)


@pytest.fixture
def project(leaking: Path, tmp_path: Path) -> Path:
    return Path(copy(leaking, tmp_path / "machine.toml"))


@pytest.fixture(scope="module")
def trace(leaking: Path) -> Path:
    return leaking.with_name("trace.parquet")


def test_diagnose_add_matches_undo_and_named_again(
    project: Path, trace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = project.read_bytes()
    done = in_json("add", trace, "--project", project)
    assert [(c["effect"], c["where"]) for c in done["changes"]] == [(LEAK, "a-b")]
    assert project.read_bytes().startswith(old), "what the user wrote stays, comments and all"

    (section,) = load(project).sections.added
    errors, size = section.errors, section.parameters["coefficient"]
    assert size.value == pytest.approx(TRUTH, rel=0.15)
    assert size.unit == "m3/s/Pa" and 0 < (size.sd or 0) < 0.1 * TRUTH
    assert (errors.rho.before or 0) > 50 and (errors.rho.after or 9) < 1.5
    for pair in (errors.identification_pct, errors.heldout_pct):
        assert (pair.after or 9) < 0.25 * (pair.before or 0)
    assert (errors.heldout_m3s.after or 9) < 1.3 * (errors.noise_floor_m3s or 0)
    assert section.date is not None and section.trace == trace.name
    assert section.reason.startswith("named by the diagnosis")

    after = diagnose_trace(load(project), trace).diagnosis
    # the true gap widens with the pressure, the column's does not: a finer grid takes what is left
    assert (after.verdict, after.found, after.is_slight) == ("insufficient_data", (), True)
    assert after.rho_after < 1.1
    assert [(a.effect, a.where) for a in after.added] == [(LEAK, "a-b")]
    assert after.added[0].parameters["coefficient"].value == pytest.approx(size.value, rel=1e-2)
    assert after.rho_before == pytest.approx(errors.rho.after, rel=0.05)
    assert LEAK not in {u.effect for u in after.not_found}
    with pytest.raises(RefusedError, match="says insufficient_data, and names"):
        add(project, trace)

    assert ends("undo", "--project", project) == Exit.OK
    assert project.read_bytes() == old
    diagnosed = diagnose_trace(load(project), trace)
    again = diagnosed.diagnosis
    assert [(f.effect, f.where) for f in again.found] == [(LEAK, "a-b")]
    assert not again.held_out_judged, "so short a record is judged itself"
    told = again.found[0].heldout_residual_before_m3s, again.found[0].heldout_residual_after_m3s
    # of the rows that it was judged by: what is listed beside it leaves others
    flow_m3s = diagnosed.result.found[0].after.flow_m3s
    shares, pair = [100 * m3s / flow_m3s for m3s in told], errors.identification_pct
    assert shares == pytest.approx([pair.before, pair.after], rel=1e-6)

    capsys.readouterr()
    told = in_json("history", "--project", project)["changes"]
    assert [c["change"] for c in told] == ["add", "undo"]
    assert told[1]["errors"]["heldout_pct"]["after"] == errors.heldout_pct.before


@pytest.mark.long
def test_two_adds_then_two_undos(project: Path, trace: Path) -> None:
    texts = [project.read_bytes()]
    add(project, trace, LEAK, "a-b", reason="the seal is old")
    texts.append(project.read_bytes())
    first = load(project).sections.added[0]
    done = add(project, trace, DRIFT, force=True)
    assert done.is_written and done.changes[0].reason.startswith("forced: ")
    both = load(project).sections.added
    assert [s.effect for s in both] == [LEAK, DRIFT]
    assert both[0].reason == "the seal is old" and both[0].errors == first.errors
    assert both[0].parameters != first.parameters, "refitted with the second one"

    cost = drop(project, LEAK, trace=trace, dry_run=True).changes[0].errors
    assert cost["heldout_pct"]["after"] > 4 * cost["heldout_pct"]["before"]
    for text in reversed(texts):
        undo(project)
        assert project.read_bytes() == text
    assert len(history(project)) == 4


def test_a_wrong_effect_is_refused_with_figures(
    project: Path, trace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = project.read_bytes()
    assert ends("add", WRONG, trace, "--project", project) == Exit.NEGATIVE
    told = capsys.readouterr().err
    assert "of the misfit: something else is missing first" in told and " % with it" in told
    assert LEAK in told, "and what would explain more"
    assert project.read_bytes() == old
    assert not path_of(project).exists()


def test_a_trial_writes_nothing(
    project: Path, trace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = project.read_bytes()
    assert ends("add", LEAK, trace, "--project", project, "--dry-run") == Exit.OK
    told = capsys.readouterr().out
    assert "would be part of the model" in told and "Held-out part: error" in told
    assert project.read_bytes() == old
    assert sorted(p.name for p in project.parent.iterdir()) == ["machine.toml"]


def test_bad_names_are_refused_before_the_fit(project: Path) -> None:
    nowhere = Path("no such trace")
    with pytest.raises(EffectError) as caught:
        add(project, nowhere, "internal_leakage_laminr")
    assert LEAK in caught.value.remedy
    project.chmod(0o444)
    with pytest.raises(Exception, match="read-only"):
        add(project, nowhere, LEAK)


@pytest.mark.parametrize(
    ("effect", "where", "words"),
    [
        (LEAK, "b", "does not act at 'b'"),
        ("coulomb_friction", "", "has no column"),
        ("input_delay", "a", "does not act at 'a'"),
    ],
)
def test_what_this_machine_cannot_have(
    project: Path, trace: Path, effect: str, where: str, words: str
) -> None:
    with pytest.raises(RefusedError, match=words) as caught:
        add(project, trace, effect, where)
    assert caught.value.remedy


@pytest.mark.long
def test_a_set_of_equals_needs_a_choice(tmp_path: Path) -> None:
    """20 s do not tell oil in a hose from the hose's wall."""
    project = recorded(tmp_path, "extra_dead_volume=middle", 20.0)
    old, trace = project.read_bytes(), project.with_name("trace.parquet")
    with pytest.raises(RefusedError, match="apart") as caught:
        add(project, trace)
    assert "hose_compliance:" in caught.value.remedy
    assert project.read_bytes() == old
    chosen = add(project, trace, "extra_dead_volume", force=True)
    volume = chosen.changes[0].section["parameters"]["volume"]
    assert volume["value"] > 0.0
    after = diagnose_trace(load(project), trace).diagnosis
    assert after.found == () and after.verdict in ("matches", "insufficient_data"), after.rho_after
    undo(project)
    assert project.read_bytes() == old


def found(effect: str, where: str, *alike: tuple[str, str]) -> Any:
    names = tuple(name for name, _ in alike)
    return SimpleNamespace(effect=effect, where=where, alike=alike, cannot_be_told_from=names)


@pytest.mark.long
def test_all_that_is_clear_is_added_and_the_choice_is_told(
    project: Path, trace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The diagnosis of a record with three effects, the last of which has a double."""
    old, whole = project.read_bytes(), load(project)
    read = read_trace(whole, trace)
    named = [
        found(LEAK, "a-b"),
        found("pressure_sensor_lag", "a"),
        found("relief_valve", "a", ("external_leakage_laminar", "a")),
    ]
    diagnosis = SimpleNamespace(verdict="missing", found=named)
    told = SimpleNamespace(model=whole.model, trace=read, diagnosis=diagnosis)
    monkeypatch.setattr(rtid.Study, "diagnosed", told)

    done = add(project, trace)
    assert [c.effect for c in done.changes] == [LEAK, "pressure_sensor_lag"]
    assert "relief_valve:a and external_leakage_laminar:a" in done.note
    sections = load(project).sections.added
    assert [s.effect for s in sections] == [LEAK, "pressure_sensor_lag"]
    assert sections[1].errors.rho.before == sections[0].errors.rho.after
    assert undo(project).changes[0].effect == "pressure_sensor_lag"
    assert [s.effect for s in load(project).sections.added] == [LEAK]
    undo(project)
    assert project.read_bytes() == old


def test_parts_come_back_with_their_shapes(project: Path, trace: Path) -> None:
    whole = load(project)
    chunk, _ = parts(whole, whole.model, read_trace(whole, trace))
    weights = prepare(whole.model, chunk)
    lag = AddedEffect("spool_lag_first_order", COMMAND, {"time_constant": 4e-3}, own_spools=True)
    delay = AddedEffect("input_delay", COMMAND, {"delay": 3e-3})
    relief = AddedEffect(
        "relief_valve", "b", {"slope": 1e-11, "opening_pressure": 3e6, "own_time_constant": 0.02}
    )
    again = recall(whole.model, chunk, weights, (delay, relief, lag))
    assert [(t.effect, t.own_spools, psi) for t, psi in again.timings] == [
        ("input_delay", False, (3e-3,)),
        ("spool_lag_first_order", True, (4e-3,)),
    ]
    (candidate,) = again.effects
    assert candidate.key == ("relief_valve", "b")
    assert candidate.shape == (3e6, 0.02, 0.0)
    for wrong, told in (
        (replace(relief, effect="coulomb_friction"), "cannot act in this record"),
        (replace(relief, parameters={"slope": 1.0}), "has no parameter opening_pressure"),
        (replace(delay, effect="no_such_timing"), "is no effect on a command"),
    ):
        with pytest.raises(PartError, match=told) as caught:
            recall(whole.model, chunk, weights, (wrong,))
        assert "rtid drop" in caught.value.remedy


@pytest.mark.long
def test_a_study_reads_once_and_adds_as_the_command_does(
    project: Path, trace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    twin, reads = Path(copy(project, tmp_path / "twin.toml")), list[Any]()

    def counted(*arguments: Any) -> Trace:
        reads.append(arguments)
        return read_trace(*arguments)

    monkeypatch.setattr("rtid.study.study.read_trace", counted)
    study = rtid.Study(str(project), str(trace))
    assert study.diagnosis() is study.diagnosis() and study.diagnosis().found[0].effect == LEAK
    assert study.trace.duration_s == pytest.approx(40.0, abs=0.1) and len(reads) == 1
    done = study.add(f"{LEAK}:a-b")
    assert done.is_written and study.project.sections.added[0].effect == LEAK
    assert [change.effect for change in study.revisions] == [LEAK]
    assert not vars(study).keys() & {"diagnosed", "standing", "replay"}, "what was learned without"

    assert ends("add", f"{LEAK}:a-b", trace, "--project", twin) == Exit.OK
    one, two = (load(p).sections.added[0] for p in (project, twin))
    assert (one.parameters, one.errors) == (two.parameters, two.errors)
